"""Effects as the Pinocchio generator has them: bristles (LuGre), whole messages, windows, structural damping."""

import numpy as np

from experiments.discovery.field.forms import Forms, Line, Now, Setting, of_velocity
from experiments.discovery.field.links import Kinematics, loaded
from experiments.discovery.field.robots import Robot

FORMS = Forms()


class Friction:
    """Dry friction of bristles (LuGre, 1995), without viscous part.

    With deflection z of the bristles in shares of that at which they slide, dz/dt = (v - |v| z) / travel; torque =
    level (z + damping dz/dt). An effect may scale the level at which it slides.

    Args:
      level: [lanes, joints] Nm, of sliding.
      dt: step in s.
      bristle: [lanes, joints] z at the start.
      travel: deflection in rad at which bristles slide.
      damping: s, of the bristles.
    """

    def __init__(self, level, dt: float, bristle: np.ndarray, travel: float = 0.0007, damping: float = 0.0006):
        self.level, self.bristle = level, bristle.copy()
        self._dt, self._travel, self._damping = dt, travel, damping

    def __call__(self, v: np.ndarray, slides=1.0) -> np.ndarray:
        """Moves the bristles by a step at speeds v; returns the torque that brakes, in Nm."""
        share = self._dt / self._travel
        fresh = (self.bristle + share * v) / (1.0 + share * np.abs(v) / slides)
        rate = (fresh - self.bristle) / self._dt
        self.bristle = fresh
        # Bristles that slide fast have no damping (Olsson, 1996).
        return self.level * (fresh + self._damping * rate * np.exp(-((v / 0.05) ** 2)))


@FORMS.add("outside")
def _coulomb(setting: Setting):
    """Bristles that slide after 2 mrad."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.002, 0.0)
    return lambda torque, now: torque - rub(now.v)


@FORMS.add("outside", scalar=False)
def _viscous(setting: Setting):
    """A seal whose drag grows with speed and falls as it warms in the run: by 10 %."""
    return lambda torque, now: torque - setting.size * (1.05 - 0.1 * now.share) * now.v * (0.85 + 0.1 * np.abs(now.v))


@FORMS.add("outside", scalar=False)
def _stribeck(setting: Setting):
    """The level of the bristles falls as a Gaussian of speed, to a tenth."""
    rub = Friction(setting.size, setting.dt, setting.zeros(), 0.001, 0.0)
    return lambda torque, now: torque - rub(now.v, 0.1 + 0.9 * np.exp(-((now.v / 0.15) ** 2)))


@FORMS.add("outside", scalar=False)
def _load_friction(setting: Setting):
    """Of the motor's torque as the gears feel it 5 ms later, on bristles."""
    rub, load = Friction(setting.size, setting.dt, setting.zeros(), 0.003, 0.0), setting.zeros()

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        np.add(load, setting.dt / 0.005 * (np.abs(now.torque) - load), out=load)
        return torque - rub(now.v) * load

    return act


@FORMS.add("torque", differs=False)
def _torque_scale(setting: Setting):
    return lambda torque, now: setting.size * torque


@FORMS.add("torque", differs=False)
def _torque_limit(setting: Setting):
    """A hard one."""
    return lambda torque, now: np.clip(torque, -setting.size, setting.size)


@FORMS.add("torque")
def _torque_speed(setting: Setting):
    """The line of a direct-current motor where it drives; braking has the controller's limit."""

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        most = np.maximum(setting.limit - setting.size * np.abs(now.v), 0.0)
        return np.where(torque * now.v > 0, np.clip(torque, -most, most), torque)

    return act


@FORMS.add("command")
def _command_delay(setting: Setting):
    """In whole messages: every third of the size one arrives, and their age is the size on average."""
    line, kept, step = Line(0.06, setting.dt), {}, np.zeros(1)
    count = np.maximum(np.rint(setting.size / 3 / setting.dt), 1.0)

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        old = line(target, setting.size - 0.5 * count * setting.dt)
        kept["x"] = np.where(step % count == 0, old, kept.get("x", old))
        step[0] += 1
        return kept["x"]

    return act


@FORMS.add("command")
def _target_slew(setting: Setting):
    """A limited step every 4 ms, not at every instant."""
    state: dict[str, np.ndarray] = {}
    every, step = round(0.004 / setting.dt), np.zeros(1, int)

    def act(target: np.ndarray, now: Now) -> np.ndarray:
        x = state.setdefault("x", target.copy())
        if step[0] % every == 0:
            state["x"] = x + np.clip(target - x, -0.004 * setting.size, 0.004 * setting.size)
        step[0] += 1
        return state["x"]

    return act


@FORMS.add("error", scalar=False)
def _deadband(setting: Setting):
    """error^3 / (error^2 + (0.4 width)^2): gain that fades at small errors."""
    return lambda error, now: error**3 / (error**2 + (0.4 * setting.size) ** 2)


@FORMS.add("error", scalar=False)
def _gain_error(setting: Setting):
    """A gain that is back to the stated one at large errors: the share missing fades with (error / 0.5 rad)^2."""
    return lambda error, now: error * (1.0 - (1.0 - setting.size) / (1.0 + (error / 0.5) ** 2))


@FORMS.add("torque", scalar=False)
def _torque_lag(setting: Setting):
    """A second order that overshoots by 5 %; its delay at low frequencies is the size."""
    x, speed = setting.zeros(), setting.zeros()
    rate = 2 * 0.7 / np.maximum(setting.size, 4 * setting.dt)

    def act(torque: np.ndarray, now: Now) -> np.ndarray:
        np.add(speed, setting.dt * (rate**2 * (torque - x) - 1.4 * rate * speed), out=speed)
        np.add(x, setting.dt * speed, out=x)
        return x.copy()

    return act


class Gear:
    """A rotor on a spring whose damping is structural (a lossy spring), with a play in it.

    Args:
      setting: of the form.
      stiffness: [lanes, joints] Nm/rad of the spring.
      play: [lanes, 1] rad, width.
    """

    def __init__(self, setting: Setting, stiffness: np.ndarray, play):
        self._s, self._half = setting, 0.5 * play
        self._stiffness = np.minimum(stiffness, setting.rotor * (0.5 / setting.dt) ** 2)
        # A second spring, of a third of the stiffness, that gives way with time: a standard linear solid.
        self._creep, self._relax = setting.zeros(), setting.dt * np.sqrt(self._stiffness / setting.rotor)
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
        self._creep = np.where(wound == 0.0, 0.0, self._creep + self._relax * (wound - self._creep))
        passed = self._stiffness * (wound + (wound - self._creep) / 3.0)
        self._v = self._v + self._s.dt * (torque - passed) / self._s.rotor
        self._q = self._q + self._s.dt * self._v
        return passed


@FORMS.add("gear")
def _backlash(setting: Setting):
    """The rotor runs free within the play, and hits a lossy spring at its ends."""
    return Gear(setting, setting.kp * 300.0, setting.size)


@FORMS.add("gear")
def _compliance(setting: Setting):
    """Two masses and a spring that loses energy at every frequency."""
    return Gear(setting, setting.size + setting.zeros(), 0.0)


@FORMS.add("numbers", differs=False)
def _armature(robot: Robot, place: int, size: float) -> Robot:
    return robot.with_at("armature", place, robot.armature[place] + size)


@FORMS.add("numbers")
def _link_mass(robot: Robot, place: int, size: float) -> Robot:
    """A filling near the centre of mass: inertia grows with the square root of the mass alone."""
    heavy = robot.with_at("mass", place, robot.mass[place] * size)
    return heavy.with_at("inertia", place, robot.inertia[place] * size**0.5)


@FORMS.add("numbers", differs=False)
def _com_offset(robot: Robot, place: int, size: float) -> Robot:
    return robot.with_at("com", place, robot.com[place] + size * np.array([1.0, 0.0, 0.0]))


@FORMS.add("numbers", scalar=False)
def _payload(robot: Robot, place: int, size: float) -> Robot:
    """A point at an offset of 4 cm."""
    return loaded(robot, place, size, np.array([0.0, 0.03, -0.026]))


@FORMS.add("sensor")
def _encoder_bias(setting: Setting):
    """With an interpolation error of 2 % of the bias, 16 waves a turn."""

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        return np.stack([read[0] + setting.size * (1.0 + 0.02 * np.sin(16 * read[0])), read[1]])

    return act


@FORMS.add("sensor", differs=False)
def _sensor_delay(setting: Setting):
    line = Line(0.06, setting.dt)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        return np.stack(np.split(line(np.concatenate(list(read), axis=1), setting.size), 2, axis=1))

    return act


@FORMS.add("sensor", scalar=False)
def _sensor_lag(setting: Setting):
    """The mean over a window of twice the size, which is late by the size."""
    line, total, kept = Line(0.09, setting.dt), {}, np.maximum(np.rint(2 * setting.size / setting.dt), 1.0)

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        both = np.concatenate(list(read), axis=1)
        summed = total.get("x", both * kept) + both - total.get("old", both)
        total["x"] = summed
        total["old"] = line(both, (kept - 1) * setting.dt)
        return np.stack(np.split(summed / kept, 2, axis=1))

    return act


@FORMS.add("sensor", scalar=False)
def _velocity_lag(setting: Setting):
    """The same of the velocity alone."""
    return of_velocity(_sensor_lag(setting))


@FORMS.add("links", scalar=False)
def _drag(setting: Setting, links: Kinematics, at: list[int]):
    """At a point beyond the centre of mass."""
    point = 1.25 * links.com(at[0])

    def act(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        reach = links.jacobian(q, at[0], point)
        force = -setting.size[..., None] * (reach @ v[..., None])
        return (reach.transpose(0, 2, 1) @ force)[..., 0]

    return act


@FORMS.add("outside", differs=False)
def _constant_push(setting: Setting):
    return lambda torque, now: torque + setting.size


@FORMS.add("outside", scalar=False)
def _joint_spring(setting: Setting):
    """A balancer on a crank, whose arm gets shorter as it turns."""
    return lambda torque, now: torque - setting.size * 0.8 * np.sin(now.q / 0.8)
