"""Robots on the rig, the motion that they are sent, and the same motion in MuJoCo C."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path

import jax
import mujoco
import numpy as np

from envs.effects.memory import LONGEST_S
from envs.rig import Rig
from envs.segments import HISTORY_S, Segment

ARM = (Path(__file__).parents[1] / "experiments" / "arm.xml").read_text()
ARM_JOINTS = ("shoulder", "elbow")
# No two are alike, so that none can stand in another's place.
ARM_SCALES = {
    "torque": np.array([1.5, 0.8]),
    "damping": np.array([0.5, 0.3]),
    "stiffness": np.array([75.0, 40.0]),
    "inertia": np.array([0.11, 0.03]),
    "mass": np.array([1.2, 0.6]),
    "drag": np.array([11.8, 5.9]),
    "speed": np.array([3.0, 4.0]),
    "slow": np.array([0.31, 0.42]),
    "motor": np.array([1.9, 2.7]),
}
CONTROL_HZ = 200.0
STEPS = 150


@dataclass(frozen=True)
class Program:
    """A function of a rig. Those of rigs of equal layout are equal, so they are compiled once."""

    rig: Rig = field(compare=False)
    layout: Hashable
    function: Callable

    def __call__(self, system, *args):
        return self.function(self.rig.on(system), *args)


_run = jax.jit(lambda program, *args: program(*args), static_argnums=0)


class Player:
    """A rig whose motion is compiled once for all rigs of its layout."""

    def __init__(self, rig):
        self.rig = rig
        self._system = jax.device_put(rig.system)

    def run(self, function, vector, *args):
        """Calls a function of the rig, of an effect's values, and of what else it is given."""
        values = self.rig.values(self.rig.tree(vector))
        return _run(Program(self.rig, self.rig.layout, function), self._system, values, *args)

    def vector(self, **effects):
        """Coordinates [axes] of physical values: `effect={place: {parameter: value}}`."""
        vector = np.zeros(len(self.rig.axes), np.float32)
        left = {(effect, *cell) for effect, places in effects.items() for cell in cells(places)}
        for number, axis in enumerate(self.rig.axes):
            cell = (axis.effect, axis.place, axis.parameter)
            if cell in left:
                left.remove(cell)
                row = self.rig.effects[axis.effect]
                (parameter,) = [parameter for parameter in row.parameters if parameter.name == axis.parameter]
                value = effects[axis.effect][axis.place][axis.parameter]
                vector[number] = parameter.coordinate(value, float(self.rig.scale(row, parameter)[axis.index]))
        assert not left
        return vector

    def play(self, segment, **effects):
        return self.read(self.vector(**effects), segment)

    def read(self, vector, segment):
        return jax.tree.map(np.asarray, self.run(Rig.simulate, vector, segment))

    def model(self, **effects):
        return self.run(Rig.model, self.vector(**effects))


def cells(places):
    return [(place, name) for place, parameters in places.items() for name in parameters]


def arm():
    return Player(Rig(mujoco.MjSpec.from_string(ARM), ARM_JOINTS, CONTROL_HZ).scaled(ARM_SCALES))


def segment(rig, start, target, kp=0.0, kd=0.0, limit=np.inf, feed=0.0, emf=0.0, speed=0.0, steps=STEPS):
    """A robot that has been at `start` [joints] with the first target, read at every step of `target` [steps, joints].

    Where it has a speed [joints], it came there with it.
    """
    before, ahead = round(HISTORY_S / rig.dt), round(LONGEST_S / rig.dt)
    joints = len(rig.joints)
    target = np.broadcast_to(target, (steps, joints))
    target = np.concatenate([np.broadcast_to(target[0], (before, joints)), target])
    speed = np.broadcast_to(speed, joints)
    time = rig.dt * np.arange(-before, ahead + 1)[:, None]
    measured = np.stack([start + time * speed, speed + 0 * time, speed + 0 * time, 0 * (speed + time)], axis=1)
    held = {"feed": feed, "stiffness": kp, "damping": kd, "limit": limit, "emf": emf}
    every = round(1.0 / rig.control_hz / rig.dt)
    return Segment(
        target=target.astype(np.float32),
        between=np.zeros_like(target, np.float32),
        **{name: np.broadcast_to(value, target.shape).astype(np.float32) for name, value in held.items()},
        sample=(np.arange(len(target)) - before) % every == 0,
        measured=measured.astype(np.float32),
        past=measured[:1, 0].astype(np.float32),
        past_target=target[:1].astype(np.float32),
        past_told=target[0].astype(np.float32),
        past_feed=np.broadcast_to(feed, joints).astype(np.float32),
        row_step=np.arange(steps, dtype=np.int32),
        row_share=np.zeros(steps, np.float32),
    )


def in_mujoco(rig, model, segment, command=None, sense=None, motor=None, outside=None, start=None):
    """What MuJoCo C reads of a segment at every step, positions and velocities [steps, 2, joints].

    Args:
      command: what becomes of targets [steps, joints], of a robot that has stood still before.
      sense: what becomes of a reading [2, joints].
      motor: what becomes of a torque [joints].
      outside: sets forces of `data`.
      start: where it is [2, joints], if not where it was measured.
    """
    before = round(HISTORY_S / rig.dt)
    drive = {
        name: np.asarray(getattr(segment, name), float)
        for name in ("target", "feed", "stiffness", "damping", "limit", "emf", "sample")
    }
    if command is not None:
        drive["target"] = command(drive["target"])
    data = mujoco.MjData(model)
    # Positions of a semi-implicit step are half a step ahead of its velocities; that makes it of second order.
    lead = 0.5 * model.opt.timestep
    position, velocity = np.asarray(segment.measured[before, :2] if start is None else start)
    data.qpos[rig.qpos], data.qvel[rig.dof] = position + lead * velocity, velocity
    read, held = [], None
    for step in range(before, len(segment.target)):
        x = {name: values[step] for name, values in drive.items()}
        seen = np.stack([data.qpos[rig.qpos] - lead * data.qvel[rig.dof], data.qvel[rig.dof]])
        seen = seen if sense is None else sense(seen)
        read.append(seen)
        if x["sample"]:
            wanted = x["stiffness"] * (x["target"] - seen[0]) - x["damping"] * seen[1]
            held = np.clip(wanted, -x["limit"], x["limit"]) + x["feed"]
        torque = held if motor is None else motor(held)
        data.qfrc_applied[rig.dof] = torque - x["emf"] * data.qvel[rig.dof]
        if outside is not None:
            outside(data)
        mujoco.mj_step(model, data)
    return np.array(read)


def compiled(text, rig):
    """An MJCF as MuJoCo C moves it, with the rig's step."""
    model = mujoco.MjSpec.from_string(text).compile()
    model.opt.timestep = rig.dt
    return model
