"""The joint controllers that a log may come from, and their law.

Whatever simulates, checks or imitates a controller calls `Impedance.torque`, or refers to it where it must be JAX.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

GAINS = {"pd": ("kp", "kd", "torque_limit_nm"), "servo": ("gain", "kt", "resistance_ohm"), "unknown": ()}
"""Names of a controller's numbers by its type; each is given for all joints or one per joint."""

OPTIONAL_GAINS = {"pd": ("kt",), "servo": ("volts",), "unknown": ("kt",)}
"""Further numbers that a controller may have: the torque constant, for logs of motor currents, and the supply voltage,
where it was not recorded."""

FOLLOWING_HZ = 1000.0
"""Rate of the controller that takes the place of an unknown one."""

BETWEEN_ROWS = ("hold", "linear", "unknown")
"""How targets go on between two rows of a log: held until the next row, in a straight line to it, or unknown."""


@dataclass(frozen=True, kw_only=True)
class Impedance:
    """A joint controller as a limited spring and damper, with the braking of its motor beside it.

    Both types of controller reduce to it, so whatever simulates or checks a controller needs no other form. The joint
    feels `torque(...) - back_emf velocity`; the second term acts continuously, also between the controller's ticks and
    beyond its limit.

    All fields have the shape [joints], or [rows, joints] where supply or enabling change with time.
    """

    stiffness: np.ndarray  # Nm/rad
    damping: np.ndarray  # Nm s/rad, of the controller
    limit: np.ndarray  # Nm, infinite where there is none
    back_emf: np.ndarray  # Nm s/rad, of the motor's back electromotive force

    def torque(self, target: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Computes the torque that the controller commands, without the back electromotive force.

            clip(stiffness (target - position) - damping velocity, -limit, limit)

        Args:
          target: [..., joints] rad.
          position: [..., joints] rad, as the controller reads it.
          velocity: [..., joints] rad/s, as the controller reads it.

        Returns:
          [..., joints] Nm.
        """
        torque = self.stiffness * (target - position) - self.damping * velocity
        # As np.clip, which takes several times as long for a few joints.
        return np.minimum(np.maximum(torque, -self.limit), self.limit)

    def __getitem__(self, index) -> "Impedance":
        """Takes some rows (or joints, of one without rows), as of an array."""
        return Impedance(
            stiffness=self.stiffness[index],
            damping=self.damping[index],
            limit=self.limit[index],
            back_emf=self.back_emf[index],
        )


@dataclass(frozen=True, kw_only=True)
class Controller:
    """What turns a joint's position target into its torque; the `controller` of `meta.yaml`.

    With e = target - q, and everything zero where the motors are switched off:

        pd:     torque = clip(kp e - kd dq, -torque_limit_nm, torque_limit_nm)
        servo:  duty = clip(gain e, -1, 1)
                stall = volts kt / resistance_ohm
                torque = kt (duty volts - kt dq) / resistance_ohm
                       = clip(gain stall e, -stall, stall) - kt^2 / resistance_ohm dq

    `impedance` brings these into one form. Where the controller is unknown, `envs.following` puts one of its own in its
    place, with the gains of a `pd` controller.
    """

    kind: str
    """`pd` (position and velocity error, limited), `servo` (position error sets the duty cycle of a DC motor) or
    `unknown` (only the motion and the torques that were measured say what it did)."""
    rate_hz: float
    """How often it reads the joint; its torque is held in between."""
    gains: Mapping[str, np.ndarray]
    """[joints] by name, the names of `GAINS` and, where they are known, `OPTIONAL_GAINS`: kp Nm/rad, kd Nm s/rad,
    torque_limit_nm Nm; gain 1/rad, kt Nm/A at the joint, resistance_ohm Ohm, volts V."""
    between_rows: str = "unknown"
    """How targets go on between two rows, one of `BETWEEN_ROWS`."""

    def impedance(self, enabled: np.ndarray | None = None, volts: np.ndarray | None = None) -> Impedance:
        """Writes the controller as a limited spring and damper, the same form for all types.

        Args:
          enabled: [rows], 0 where the motors are switched off and 1 elsewhere; always on where None.
          volts: [rows] V, the recorded supply; where None, a servo takes its gain `volts`. A PD controller ignores it.

        Returns:
          Of shapes [rows, joints], or [joints] where nothing that was given has rows.

        Raises:
          ValueError: a servo has neither.
        """
        gains, on = self.gains, 1.0 if enabled is None else np.asarray(enabled)[..., None]
        if self.kind != "servo":
            stiffness = on * gains["kp"]
            return Impedance(
                stiffness=stiffness,
                damping=on * gains["kd"],
                # Not a product: the limit may be infinite.
                limit=np.where(on > 0, gains["torque_limit_nm"], 0.0),
                back_emf=np.zeros_like(stiffness),
            )
        if volts is None and "volts" not in gains:
            raise ValueError("controller.volts: is missing, and so is a column 'volts'; a servo needs one of them")
        supply = gains["volts"] if volts is None else np.asarray(volts)[..., None]
        stall = on * supply * gains["kt"] / gains["resistance_ohm"]
        return Impedance(
            stiffness=stall * gains["gain"],
            damping=np.zeros_like(stall),
            limit=stall,
            back_emf=np.broadcast_to(on * gains["kt"] ** 2 / gains["resistance_ohm"], stall.shape),
        )
