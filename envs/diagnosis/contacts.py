"""Finds contacts that a suspended or clamped robot must have had, by the model's geometry at the measured positions."""

from collections.abc import Sequence

import mujoco
import numpy as np

from envs.diagnosis.finding import Finding
from envs.logs import Run

_ROWS = 50  # of a run, at most
_DEEP_M = 0.002
_SHARES = (0.05, 0.95)  # of the rows: fewer are a graze, and bodies that always overlap are drawn so


def contacts(run: Run, joints: tuple[str, ...], model: mujoco.MjModel) -> list[Finding]:
    """Finds bodies that touch in part of the rows; in the simulations of discovery they go through each other.

    Args:
      run: as it was read.
      joints: names of the joints, in the log's order.
      model: of the robot with contacts.
    """
    shares = touching(model, joints, run.signals["q"])
    return [
        Finding(
            "contact",
            "q",
            (),
            share,
            f"by the model's geometry {one} touches {other} in {share:.0%} of the rows; record a robot "
            "that touches nothing, or correct the geometry: contacts are not simulated",
        )
        for (one, other), share in shares.items()
        if _SHARES[0] < share < _SHARES[1]
    ]


def touching(
    model: mujoco.MjModel, joints: Sequence[str], positions: np.ndarray, most: int = _ROWS
) -> dict[tuple[str, str], float]:
    """Finds pairs of bodies that go into each other by more than 2 mm.

    Where a rig holds a free base is not known, so what such a robot touches beside itself is left out.

    Args:
      model: of the robot with contacts.
      joints: names of the joints, in the columns' order.
      positions: [rows, joints] rad or m.
      most: number of rows that are looked at, at even distances.

    Returns:
      Share of these rows by the bodies' names.
    """
    data, free = mujoco.MjData(model), (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
    address = [int(model.joint(name).qposadr[0]) for name in joints]
    rows = np.unique(np.linspace(0, len(positions) - 1, most).astype(int))
    touched: dict[tuple[str, str], int] = {}
    for row in rows:
        data.qpos[address] = positions[row]
        mujoco.mj_fwdPosition(model, data)
        deep = data.contact.geom[data.contact.dist < -_DEEP_M]
        bodies = model.geom_bodyid[deep]
        bodies = bodies[(model.body_weldid[bodies] > 0).all(axis=1)] if free else bodies
        pairs = {tuple(sorted(model.body(body).name for body in pair)) for pair in bodies}
        for pair in pairs:
            touched[pair] = touched.get(pair, 0) + 1
    return {pair: count / len(rows) for pair, count in touched.items()}
