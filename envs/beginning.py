"""Where a simulated segment of a log begins: the robot's state, and what its effects remember (`envs.rig`)."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from mujoco import mjx

from envs import history, stepping
from envs.chain import Chain
from envs.effects.memory import LONGEST_S
from envs.segments import INPUTS, Segment

# Stages whose memories depend on where links are, not on measured motors alone.
_FOLLOWED = ("transmission", "bristle", "sensor")
_RATE_S = 0.012  # over which a light rotor's speed within its gears is taken
_GEARS_S = 0.06  # of the history, in which gears that give way are simulated
_PRESSED_S = 0.01  # over which the torque on the gears is taken: that of a measured motor is noisy


def begin(
    chain: Chain, model: mjx.Model, data: mjx.Data, values: Mapping, segment: Segment
) -> tuple[mjx.Data, dict, dict]:
    """Brings a robot to the start of a segment, by the history that was measured before it.

    The history fills the memories of the effects. Its end is simulated where gears give way.

    Args:
      chain: of the robot, with all effects.
      model: of the robot, effects on its fields included.
      data: of the robot, in any state.
      values: of the effects.
      segment: the controller's inputs, and the motion measured before the segment.

    Returns:
      The robot and the memories at the segment's start, and the inputs of its controller from there on, [steps, ...] by
      name.
    """
    # Measured states go on for `LONGEST_S` after the start, because undoing a delay needs later readings.
    before = len(segment.measured) - 1 - round(LONGEST_S / chain.dt)
    drive = {name: getattr(segment, name) for name in INPUTS}
    drive["emf"], _ = chain.stage("back_emf", values, segment.emf, None, {})
    past, future = _part(drive, 0, before), _part(drive, before, None)
    truth = _undone(chain, values, segment.measured)[:, :2]
    acceleration = jnp.gradient(truth[:, 1], chain.dt, axis=0)
    inputs = jax.tree.map(lambda x: x[0], drive)
    first = chain.start(values, truth[0], inputs, segment.past_target)
    first |= _bristles(chain, model, data, values, segment, inputs)

    def remember(memory, inputs):
        return history.remember(chain, values, memory, *inputs)

    # Delays need the whole history, and gears the end of it: to simulate them takes longer than to remember.
    early = before - round(_GEARS_S / chain.dt)
    first, _ = jax.lax.scan(remember, first, (truth[:early], _part(past, 0, early)))
    past, truth, acceleration = _part(past, early, None), truth[early:], acceleration[early:]
    steps = before - early
    memory, torque = jax.lax.scan(remember, first, (truth[:steps], past))
    return *_followed(chain, model, data, values, (truth, acceleration, torque, past), first, memory), future


def _undone(chain, values, readings):
    """The motion [steps, 4, joints] that was read, without this hypothesis' errors of sensors."""
    for row in chain.entering("sensor"):
        if row.undo is not None:
            readings = row.undo(values[row.name], readings, chain.dt)
    return readings


def _bristles(chain, model, data, values, segment, inputs) -> dict:
    """Bristles as the past has wound them.

    It is assumed that the robot rested at the first past position, where bristles balanced all torques. If it moved
    then, later motion has wound them anew.
    """
    position = segment.past[0]
    # Other inputs, as gains and limits, are those of the history's first step.
    still = jnp.zeros_like(position)
    inputs = inputs | {"target": segment.past_told, "between": still, "feed": segment.past_feed}
    # Undoing a lag takes a slope, so it needs more rows than one.
    rest = _undone(chain, values, jnp.tile(jnp.stack([position, still, still, still]), (3, 1, 1)))[0, :2]
    memory, torque = history.remember(chain, values, chain.start(values, rest, inputs), rest, inputs)
    there = data.replace(qpos=data.qpos.at[chain.qpos].set(rest[0]))
    return history.bristles(chain, model, there, values, memory, torque, inputs, segment.past)


def _followed(chain, model, data, values, motion, first, memory) -> tuple[mjx.Data, dict]:
    """The robot and its memories at the end of a history in which links followed their motors.

    Args:
      chain: of the robot.
      model: of the robot.
      data: of the robot, in any state.
      values: of the effects.
      motion: what was measured without the sensors' errors, and its accelerations, [steps + 1, ...] or longer; torques
        of motors and inputs of the controller, [steps, ...].
      first: the memories at its beginning.
      memory: the memories at its end, if nothing gives way.
    """
    truth, acceleration, torque, past = motion
    steps, still = len(torque), data
    # Where joints are behind their motors was not measured. It matters, and takes time, only if gears give way.
    gears = {row.name: row.parameters[0].name for row in chain.entering("transmission")}
    gives = jnp.stack([values[name][size] != 0 for name, size in gears.items()]).any(axis=0)
    shortly = round(_PRESSED_S / chain.dt)
    speeding = acceleration[:shortly]
    needed = history.needed(chain, model, still, truth[0], speeding.mean(axis=0))
    pressing = torque[:shortly] - model.dof_armature[chain.dof] * speeding
    first = first | history.pressed(chain, values, pressing, needed)

    def at(index, data, memory, speeding):
        """The robot at a step of the motion, with accelerations [joints]."""
        state = truth[index] - chain.at_log(values, chain.ahead(memory))
        return data.replace(
            qpos=still.qpos.at[chain.qpos].set(state[0] + chain.lead_s * state[1]),
            qvel=still.qvel.at[chain.dof].set(state[1]),
            # The chain's first step needs an acceleration, for the rotors' torque.
            qacc=still.qacc.at[chain.dof].set(speeding),
            qacc_warmstart=still.qacc.at[chain.dof].set(speeding),
        )

    def follow(index, carry):
        data, memory, rates = carry
        inputs = jax.tree.map(lambda x: x[index], past)
        data, memory = history.follow(chain, model, data, memory, values, truth[index], torque[index], inputs)
        # A light rotor's speed within its gears jumps from step to step.
        rates = {name: rate + chain.dt / _RATE_S * (memory[name][1] - rate) for name, rate in rates.items()}
        return data, memory, rates

    start = stepping.placed(model, at(0, data, first, acceleration[0]))
    begun = start, first, {name: first[name][1] for name in gears}
    data, followed, rates = jax.lax.fori_loop(jnp.where(gives.any(), 0, steps), steps, follow, begun)
    rows = (row.name for row in chain.rows if row.enters in _FOLLOWED and row.start is not None)
    memory = memory | {name: jnp.where(gives, followed[name], memory[name]) for name in ("passed", "within", *rows)}
    for name in gears:
        memory[name] = memory[name].at[1].add(history.light(chain, model, data) * (rates[name] - memory[name][1]))
    data = at(steps, data, memory, jnp.where(gives, data.qacc[chain.dof], acceleration[steps]))
    # What effects read of the last step is that of the first one.
    return stepping.placed(model, data), memory


def _part(inputs, begin: int, end: int | None):
    return jax.tree.map(lambda x: x[begin:end], inputs)
