"""Effects as the MuJoCo C generator has them: hysteresis of Dahl, soft edges, hyperbolic tangents, second orders."""

import numpy as np

from experiments.discovery.field.forms import Forms, Line, Now, Setting, of_velocity
from experiments.discovery.field.links import Kinematics, loaded
from experiments.discovery.field.robots import Robot

FORMS = Forms()


class Friction:
    """Dry friction of Dahl (1968): dz/dt = v / travel (1 - sign(v) z), torque = level z.

    Args:
      level: [lanes, joints] Nm, of sliding.
      dt: step in s.
      bristle: [lanes, joints] z at the start.
      travel: displacement in rad over which friction turns round.
    """

    def __init__(self, level: np.ndarray, dt: float, bristle: np.ndarray, travel: float = 0.0008):
        self.level, self.bristle, self._dt = level, bristle.copy(), dt / travel

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Moves the hysteresis by a step at speeds v; returns the torque that brakes, in Nm."""
        # Implicit in z, so that it stays within [-1, 1] at any speed.
        self.bristle = (self.bristle + self._dt * v) / (1.0 + self._dt * np.abs(v))
        return self.level * self.bristle


@FORMS.add("outside")
def _coulomb(setting: Setting):
    """Presliding: friction turns round over 6 mrad."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.006)
    return lambda torque, now: torque - rub(now.v)


@FORMS.add("outside", scalar=False)
def _viscous(setting: Setting):
    """c (0.6 v + 0.4 v |v| / quick): partly quadratic."""
    return lambda torque, now: torque - setting.size * now.v * (0.6 + 0.4 * np.abs(now.v) / setting.quick)


@FORMS.add("outside", scalar=False)
def _stribeck(setting: Setting):
    """A Gaussian of speed, on a hysteresis."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.001)
    return lambda torque, now: torque - rub(now.v) * np.exp(-((now.v / 0.25) ** 2))


@FORMS.add("outside", scalar=False)
def _load_friction(setting: Setting):
    """Of the motor's torque alone, with presliding."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.004)
    return lambda torque, now: torque - rub(now.v) * np.abs(now.torque)


@FORMS.add("torque", differs=False)
def _torque_scale(setting: Setting):
    return lambda torque, now: setting.size * torque


@FORMS.add("torque", scalar=False)
def _torque_limit(setting: Setting):
    """limit tanh(torque / limit)."""
    return lambda torque, now: setting.size * np.tanh(torque / setting.size)


@FORMS.add("torque", scalar=False)
def _torque_speed(setting: Setting):
    """The line of a direct-current motor, with a knee that is smooth over a tenth of the limit."""
    knee = 0.1 * setting.limit

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        left = setting.limit - setting.size * now.v * np.sign(torque)
        most = knee * np.logaddexp(0.0, left / knee)
        # A smooth minimum that is zero at zero: a motor has no torque that nobody commands.
        over = np.log(np.maximum(np.abs(torque), 1e-12)) - np.log(most)
        return torque * np.exp(-0.1 * np.logaddexp(0.0, 10.0 * over))

    return act


@FORMS.add("command")
def _command_delay(setting: Setting):
    """Delays that jitter by a fifth, anew every 10 ms."""
    line, rng, state = Line(0.06, setting.dt), np.random.default_rng(1), {"step": 0, "jitter": 1.0}
    every = round(0.01 / setting.dt)

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        if state["step"] % every == 0:
            state["jitter"] = rng.uniform(0.8, 1.2)
        state["step"] += 1
        return line(target, setting.size * state["jitter"])

    return act


@FORMS.add("command", scalar=False)
def _target_slew(setting: Setting):
    """A follower that saturates smoothly: dx/dt = rate tanh((target - x) / (rate 1 ms))."""
    state: dict[str, np.ndarray] = {}

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        x = state.setdefault("x", target.copy())
        state["x"] = x + setting.dt * setting.size * np.tanh((target - x) / (setting.size * 0.001))
        return state["x"]

    return act


@FORMS.add("error", scalar=False)
def _deadband(setting: Setting):
    """error - width / 2 tanh(2 error / width): the edge is smooth."""
    half = 0.5 * setting.size
    return lambda error, now: error - half * np.tanh(error / half)


@FORMS.add("error", differs=False)
def _gain_error(setting: Setting):
    return lambda error, now: setting.size * error


@FORMS.add("torque", scalar=False)
def _torque_lag(setting: Setting):
    """Two equal stages, each with half of the time constant."""
    first, second, share = setting.zeros(), setting.zeros(), setting.dt / (0.5 * setting.size + setting.dt)

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        np.add(first, share * (torque - first), out=first)
        np.add(second, share * (first - second), out=second)
        return second.copy()

    return act


class Gear:
    """Two masses: a rotor behind a spring with a play, which is hard or grows stiffer as it is wound up.

    Args:
      setting: of the form.
      stiffness: [lanes, joints] Nm/rad of the spring.
      play: [lanes, 1] rad, width.
      hardening: 1/rad^2, relative growth of the stiffness with the square of the winding.
    """

    def __init__(self, setting: Setting, stiffness: np.ndarray, play, hardening: float = 0.0):
        self._s, self._half, self._hardening = setting, 0.5 * play, hardening
        # The stiffest spring that the step can follow.
        self._stiffness = np.minimum(stiffness, setting.rotor * (0.5 / setting.dt) ** 2)
        self._damping = 0.1 * np.sqrt(self._stiffness * setting.rotor)
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
        wound = np.sign(wound) * np.maximum(np.abs(wound) - self._half, 0.0)
        spring = self._stiffness * wound * (1.0 + self._hardening * wound**2)
        passed = spring + np.where(wound != 0.0, self._damping * (self._v - v), 0.0)
        self._v = self._v + self._s.dt * (torque - passed) / self._s.rotor
        self._q = self._q + self._s.dt * self._v
        return passed


@FORMS.add("gear")
def _backlash(setting: Setting):
    """The rotor runs free within the play, and hits a stiff spring at its ends."""
    return Gear(setting, setting.kp * 400.0, setting.size)


@FORMS.add("gear", scalar=False)
def _compliance(setting: Setting):
    """A spring that grows stiffer as it is wound up: by a tenth at 0.05 rad."""
    return Gear(setting, setting.size + setting.zeros(), 0.0, 40.0)


@FORMS.add("numbers", differs=False)
def _armature(robot: Robot, place: int, size: float) -> Robot:
    return robot.with_at("armature", place, robot.armature[place] + size)


@FORMS.add("numbers")
def _link_mass(robot: Robot, place: int, size: float) -> Robot:
    """A link that is larger all over: its inertia grows with the power 5/3 of its mass."""
    heavy = robot.with_at("mass", place, robot.mass[place] * size)
    return heavy.with_at("inertia", place, robot.inertia[place] * size ** (5 / 3))


@FORMS.add("numbers", scalar=False)
def _com_offset(robot: Robot, place: int, size: float) -> Robot:
    """Along the link and to its side."""
    return robot.with_at("com", place, robot.com[place] + size * np.array([0.8, 0.0, -0.6]))


@FORMS.add("numbers", scalar=False)
def _payload(robot: Robot, place: int, size: float) -> Robot:
    """A ball of 3 cm, beside the centre of mass."""
    return loaded(robot, place, size, np.array([0.03, 0.0, -0.02]), 0.03)


@FORMS.add("sensor", scalar=False)
def _encoder_bias(setting: Setting):
    """A disc that is eccentric by a tenth of the bias."""

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        q, v = read
        return np.stack([q + setting.size * (1 + 0.1 * np.sin(q)), v * (1 + 0.1 * setting.size * np.cos(q))])

    return act


@FORMS.add("sensor", scalar=False)
def _sensor_delay(setting: Setting):
    """Sampled and held on a clock of its own, so that readings are older by one half to three halves of the size."""
    kept: dict[str, np.ndarray] = {}
    late = Line(0.06, setting.dt)
    count = np.maximum(np.rint(setting.size / setting.dt), 1.0)
    step = np.zeros(1)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        lanes = np.concatenate(list(read), axis=1)
        old = late(lanes, 0.5 * setting.size)
        kept["x"] = np.where(step % count == 0, old, kept.get("x", old))
        step[0] += 1
        return np.stack(np.split(kept["x"], 2, axis=1))

    return act


@FORMS.add("sensor", scalar=False)
def _sensor_lag(setting: Setting):
    """Two equal stages, each with half of the time constant."""
    state: dict[str, np.ndarray] = {}
    share = setting.dt / (0.5 * setting.size + setting.dt)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        first, second = state.get("x", (read, read))
        first = first + share * (read - first)
        state["x"] = first, second + share * (first - second)
        return state["x"][1]

    return act


@FORMS.add("sensor", scalar=False)
def _velocity_lag(setting: Setting):
    """The same of the velocity alone."""
    return of_velocity(_sensor_lag(setting))


@FORMS.add("links", scalar=False)
def _drag(setting: Setting, links: Kinematics, at: list[int]):
    """force = -c speed (0.5 + 0.5 |speed| / (0.5 m/s)) at the centre of mass."""

    com = links.com(at[0])

    def act(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        reach = links.jacobian(q, at[0], com)
        speed = (reach @ v[..., None])[..., 0]
        force = -setting.size * speed * (0.5 + np.linalg.norm(speed, axis=1, keepdims=True))
        return (reach.transpose(0, 2, 1) @ force[..., None])[..., 0]

    return act


@FORMS.add("outside", differs=False)
def _constant_push(setting: Setting):
    return lambda torque, now: torque + setting.size


@FORMS.add("outside", scalar=False)
def _joint_spring(setting: Setting):
    """A cable that stiffens as it is bent."""
    return lambda torque, now: torque - setting.size * now.q * (1.0 + (now.q / 0.9) ** 2)
