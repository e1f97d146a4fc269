"""What an effect of a generator is: a formula that acts at one stage between target and reading.

    target -> command -> error -> PD law, at ticks -> torque -> gear -> joint, with friction and outside -> sensor

A form is made for some columns (joints) of all lanes at once. Its size is the value of the library's first parameter.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a form may know of the robots when it is made; arrays are [lanes, joints of the form]."""

    dt: float
    """Step of the plant in s."""
    period: float
    """Of the controller in s."""
    size: np.ndarray
    """[lanes, 1] value of the effect's first parameter, in its unit."""
    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    rotor: np.ndarray
    """Rotor's inertia in kg m^2, for a form of the stage `gear`."""
    quick: np.ndarray
    """Typical speed in rad/s."""
    strong: np.ndarray
    """Typical torque in Nm."""

    def zeros(self) -> np.ndarray:
        """Returns zeros, [lanes, joints of the form]."""
        return np.zeros_like(self.kp)


@dataclass(kw_only=True)
class Now:
    """State of all lanes at one step, in the columns of a form."""

    share: np.ndarray
    """[lanes, 1] of the run that has passed."""
    q: np.ndarray
    v: np.ndarray
    torque: np.ndarray
    """Nm, of the motor."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """One effect in the formula of one generator."""

    stage: str
    """`command`, `error`, `torque`, `gear`, `outside`, `sensor`, `links` (forces that depend on the whole robot), or
    `numbers`, which changes the robot itself."""
    make: Callable
    """Returns the function that acts: (signal, now) -> signal; for `numbers`: (robot, joint, size) -> robot."""
    scalar: bool
    """Whether the size is the true value of the library's first parameter. Otherwise intervals are not scored."""
    differs: bool
    """Whether the formula is another than the library's."""


class Forms(dict):
    """The forms of one generator by the name of the effect."""

    def add(self, stage: str, scalar: bool = True, differs: bool = True) -> Callable:
        """Registers the decorated function, under its name, as the form of an effect.

        Args:
          stage: at which it acts.
          scalar: whether the size is the true value of the library's first parameter.
          differs: whether the formula is another than the library's.
        """

        def register(make: Callable) -> Callable:
            self[make.__name__.lstrip("_")] = Form(stage=stage, make=make, scalar=scalar, differs=differs)
            return make

        return register


def of_velocity(act: Callable) -> Callable:
    """Makes an act of a sensor on velocities alone of one on positions and velocities, [2, lanes, joints]."""
    return lambda read, now: np.stack([read[0], act(read, now)[1]])


class Line:
    """A delay line whose delay may change from step to step, in whole steps.

    Args:
      longest_s: largest delay.
      dt: step in s.
    """

    def __init__(self, longest_s: float, dt: float):
        self._dt, self._count = dt, int(longest_s / dt) + 2
        self._kept: np.ndarray | None = None
        self._at = 0

    def __call__(self, signal: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """Keeps a signal [lanes, joints], and returns what it was `seconds` [lanes, 1] ago."""
        if self._kept is None:
            self._kept = np.repeat(signal[None], self._count, axis=0)
        self._at = (self._at + 1) % self._count
        self._kept[self._at] = signal
        behind = np.minimum(np.rint(seconds[:, 0] / self._dt).astype(int), self._count - 1)
        return self._kept[(self._at - behind) % self._count, np.arange(len(signal))]
