"""Effects as the Bullet generator has them: spring sliders, asymmetries, hysteresis, profiles of second order."""

import numpy as np

from experiments.discovery.field.forms import Forms, Line, Now, Setting
from experiments.discovery.field.links import Kinematics, loaded
from experiments.discovery.field.robots import Robot

FORMS = Forms()


class Friction:
    """Dry friction as a spring with a slider (Prandtl, 1928): it sticks elastically, then slides at a fixed torque.

    Args:
      level: [lanes, joints] Nm, of sliding.
      dt: step in s.
      bristle: [lanes, joints] winding of the spring at the start, in shares of its `travel`.
      travel: displacement in rad at which it slides.
    """

    def __init__(self, level: np.ndarray, dt: float, bristle: np.ndarray, travel: float = 0.0006):
        self.level, self.bristle, self._step = level, bristle.copy(), dt / travel

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Moves the slider by a step at speeds v; returns the torque that brakes, in Nm."""
        self.bristle = np.clip(self.bristle + self._step * v, -1.0, 1.0)
        return self.level * self.bristle


@FORMS.add("outside", scalar=False)
def _coulomb(setting: Setting):
    """A fifth stronger in one direction, a fifth weaker in the other."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.003)
    return lambda torque, now: torque - rub(now.v) * (1.0 + 0.2 * np.sign(now.v))


@FORMS.add("outside", scalar=False)
def _viscous(setting: Setting):
    """c quick (|v| / quick)^0.8: grease that shears thin."""

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        ratio = np.abs(now.v) / setting.quick
        # Below a hundredth of `quick` linear, since the power's slope is infinite at zero.
        return torque - setting.size * now.v * np.maximum(ratio, 0.01) ** -0.2

    return act


@FORMS.add("outside", scalar=False)
def _stribeck(setting: Setting):
    """1 / (1 + (v / 0.2)^2), with a slider."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.001)
    return lambda torque, now: torque - rub(now.v) / (1.0 + (now.v / 0.2) ** 2)


@FORMS.add("outside", scalar=False)
def _load_friction(setting: Setting):
    """Of the motor's torque where it drives, and half of it where it brakes."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.003)

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        load = np.abs(now.torque) * np.where(now.torque * now.v >= 0, 1.0, 0.5)
        return torque - rub(now.v) * load

    return act


@FORMS.add("torque", scalar=False)
def _torque_scale(setting: Setting):
    """A share that differs by 4 % between the two directions."""
    return lambda torque, now: setting.size * torque * (1.0 + 0.02 * np.sign(torque))


@FORMS.add("torque", scalar=False)
def _torque_limit(setting: Setting):
    """torque / (1 + |torque / limit|^4)^(1/4)."""
    return lambda torque, now: torque / (1.0 + (torque / setting.size) ** 4) ** 0.25


@FORMS.add("torque", scalar=False)
def _torque_speed(setting: Setting):
    """An ellipse: (torque / limit)^2 + (c speed / limit)^2 <= 1 where the motor drives."""

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        share = setting.size * np.abs(now.v) / setting.limit
        most = setting.limit * np.sqrt(np.maximum(1.0 - share**2, 0.0))
        return np.where(torque * now.v > 0, np.clip(torque, -most, most), torque)

    return act


@FORMS.add("command")
def _command_delay(setting: Setting):
    """Delays that wander slowly by 15 %."""
    line, step = Line(0.06, setting.dt), np.zeros(1)

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        step[0] += 1
        return line(target, setting.size * (1.0 + 0.15 * np.sin(9.0 * step[0] * setting.dt)))

    return act


@FORMS.add("command", scalar=False)
def _target_slew(setting: Setting):
    """A profile of second order: its speed is limited, and its acceleration to the same speed within 40 ms."""
    state: dict[str, np.ndarray] = {}
    most = setting.size / 0.04

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        x, speed = state.get("x", target), state.get("speed", setting.zeros())
        left = target - x
        # The speed from which it can still stop at the target.
        wanted = np.sign(left) * np.minimum(np.sqrt(2 * most * np.abs(left) * 0.8), setting.size)
        wanted = np.where(np.abs(left) < setting.size * setting.dt, left / setting.dt, wanted)
        state["speed"] = speed + np.clip(wanted - speed, -most * setting.dt, most * setting.dt)
        state["x"] = x + state["speed"] * setting.dt
        return state["x"]

    return act


@FORMS.add("error", scalar=False)
def _deadband(setting: Setting):
    """With hysteresis: it wakes beyond half of the width, and sleeps again below a quarter of it."""
    state = {"awake": setting.zeros() > 0}

    def act(error: np.ndarray, now: Now) -> np.ndarray:
        far = np.abs(error)
        state["awake"] = (far > 0.5 * setting.size) | (state["awake"] & (far > 0.25 * setting.size))
        return np.where(state["awake"], error - 0.35 * setting.size * np.sign(error), 0.0)

    return act


@FORMS.add("error", differs=False)
def _gain_error(setting: Setting):
    return lambda error, now: setting.size * error


@FORMS.add("torque", scalar=False)
def _torque_lag(setting: Setting):
    """Half a delay, half a lag."""
    line, state = Line(0.06, setting.dt), setting.zeros()
    share = setting.dt / (0.5 * setting.size + setting.dt)

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        np.add(state, share * (line(torque, 0.5 * setting.size) - state), out=state)
        return state.copy()

    return act


class Gear:
    """A rotor behind teeth: no torque within the play, then a spring that starts soft (Hertz), or a plain spring.

    Args:
      setting: of the form.
      stiffness: [lanes, joints] Nm/rad of the spring.
      play: [lanes, 1] rad, width.
      soft: rad, winding up to which the spring is softer.
    """

    def __init__(self, setting: Setting, stiffness: np.ndarray, play, soft: float = 0.0):
        self._s, self._half, self._soft = setting, 0.5 * play, soft
        self._stiffness = np.minimum(stiffness, setting.rotor * (0.5 / setting.dt) ** 2)
        self._damping = 0.15 * np.sqrt(self._stiffness * setting.rotor)
        self._q: np.ndarray | None = None
        self._v = setting.zeros()

    def motor(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the rotor's position and speed, which the encoder reads; q and v are the joint's."""
        if self._q is None:
            self._q, self._v = q.copy(), v.copy()
        return self._q, self._v

    def __call__(self, torque: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Moves the rotor by a step under the motor's torque; returns the torque that the joint receives."""
        wound = self._q - q
        deep = np.maximum(np.abs(wound) - self._half, 0.0)
        share = np.sqrt(deep / (deep + self._soft + 1e-12))
        spring = self._stiffness * deep * np.sign(wound) * share
        passed = spring + np.where(deep > 0, self._damping * share * (self._v - v), 0.0)
        self._v = self._v + self._s.dt * (torque - passed) / self._s.rotor
        self._q = self._q + self._s.dt * self._v
        return passed


@FORMS.add("gear", scalar=False)
def _backlash(setting: Setting):
    """Teeth that are soft over the first half mrad."""
    return Gear(setting, setting.kp * 400.0, setting.size, 0.0005)


@FORMS.add("gear")
def _compliance(setting: Setting):
    """Two masses and a linear spring with damping."""
    return Gear(setting, setting.size + setting.zeros(), 0.0)


@FORMS.add("numbers", differs=False)
def _armature(robot: Robot, place: int, size: float) -> Robot:
    return robot.with_at("armature", place, robot.armature[place] + size)


@FORMS.add("numbers", differs=False)
def _link_mass(robot: Robot, place: int, size: float) -> Robot:
    heavy = robot.with_at("mass", place, robot.mass[place] * size)
    return heavy.with_at("inertia", place, robot.inertia[place] * size)


@FORMS.add("numbers", scalar=False)
def _com_offset(robot: Robot, place: int, size: float) -> Robot:
    """To one side of the link, and out of its plane."""
    return robot.with_at("com", place, robot.com[place] + size * np.array([0.9, 0.4, 0.0]))


@FORMS.add("numbers")
def _payload(robot: Robot, place: int, size: float) -> Robot:
    """A ball of 4 cm at the centre of mass."""
    return loaded(robot, place, size, np.zeros(3), 0.04)


@FORMS.add("sensor", differs=False)
def _encoder_bias(setting: Setting):
    return lambda read, now: np.stack([read[0] + setting.size, read[1]])


@FORMS.add("sensor")
def _sensor_delay(setting: Setting):
    """Delays that jitter by 15 %, anew every 5 ms."""
    line, rng, state = Line(0.06, setting.dt), np.random.default_rng(2), {"step": 0, "jitter": 1.0}
    every = round(0.005 / setting.dt)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        if state["step"] % every == 0:
            state["jitter"] = rng.uniform(0.85, 1.15)
        state["step"] += 1
        return np.stack(np.split(line(np.concatenate(list(read), axis=1), setting.size * state["jitter"]), 2, axis=1))

    return act


@FORMS.add("sensor", scalar=False)
def _sensor_lag(setting: Setting):
    """An observer of second order, whose speed is that of its own position; slow motion is late by the size."""
    state: dict[str, np.ndarray] = {}
    # x'' = w^2 (q - x) - 2 w x' is late by 2 / w.
    rate = 2.0 / np.maximum(setting.size, 4 * setting.dt)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        x, speed = state.get("x", read[0]), state.get("speed", read[1])
        state["speed"] = speed + setting.dt * (rate**2 * (read[0] - x) - 2 * rate * speed)
        state["x"] = x + setting.dt * state["speed"]
        return np.stack([state["x"], state["speed"]])

    return act


@FORMS.add("sensor", scalar=False)
def _velocity_lag(setting: Setting):
    """The way of the last steps over their time, late by half of it: what a servo makes of an encoder alone."""
    line, span = Line(0.09, setting.dt), np.maximum(np.rint(2 * setting.size / setting.dt), 1.0) * setting.dt

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        return np.stack([read[0], (read[0] - line(read[0], span)) / span])

    return act


@FORMS.add("links")
def _drag(setting: Setting, links: Kinematics, at: list[int]):
    """force = -c (speed + 0.02 m/s tanh(speed / 0.02 m/s)): a little dry friction of the cable beside its drag."""
    com = links.com(at[0])

    def act(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        reach = links.jacobian(q, at[0], com)
        speed = (reach @ v[..., None])[..., 0]
        force = -setting.size * (speed + 0.02 * np.tanh(speed / 0.02))
        return (reach.transpose(0, 2, 1) @ force[..., None])[..., 0]

    return act


@FORMS.add("outside")
def _constant_push(setting: Setting):
    """With a slow ripple of 5 %, as of a spring that the robot pulls along."""
    return lambda torque, now: torque + setting.size * (1.0 + 0.05 * np.sin(20.0 * now.share))


@FORMS.add("outside", differs=False)
def _joint_spring(setting: Setting):
    """It rests at a quarter of a radian."""
    return lambda torque, now: torque - setting.size * (now.q - 0.25)
