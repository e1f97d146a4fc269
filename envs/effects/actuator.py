"""Effects between the target and the motor's torque.

Signals are [joints]: targets in rad (`command`), target less position in rad (`error`), motor torques in Nm (`torque`).
Several of them look alike in a log (delay and lag; mass, friction and torque scale), so each row says which experiment
separates it from the others.
"""

import jax
import jax.numpy as jnp

from envs.effects.memory import LONGEST_S, PAST_TARGET_S, SECOND_STAGE, delay_line, delayed, lagged, two_stages
from jaxtune.types import Effect, Form, Parameter

_ACTUATOR = {"family": "actuator", "on": "joint"}


def scaled(values, signal, now, memory):
    """signal' = ratio signal; `values` hold the logarithm of the ratio."""
    del now
    return signal * jnp.exp(values["ratio"]), memory


def _gain_error(values, error, now, memory):
    """error' = error (1 + (ratio - 1) / (1 + |error| / within)); `values` hold 1 / within, zero at all errors alike."""
    del now
    return error * (1.0 + jnp.expm1(values["ratio"]) / (1.0 + jnp.abs(error) * values["within_rad"])), memory


def _torque_limit(values, torque, now, memory):
    """torque' = clip(torque, -limit, limit); `values` hold 1 / limit, which is zero where there is none.

    A soft limit is torque / (1 + |torque / limit|^n)^(1 / n) with n = 1 / softness.
    """
    del now
    # A reciprocal of zero becomes a limit that no motor reaches, without a division by zero.
    limit = 1.0 / jnp.maximum(values["torque_nm"], 1e-9)
    hard = jnp.clip(torque, -limit, limit)
    softness = jnp.maximum(values["softness"], _HARDEST)
    # Of the larger of both, so that no power overflows: with share = smaller / larger it is a factor next to one.
    share = jnp.minimum(jnp.abs(torque), limit) / jnp.maximum(jnp.maximum(jnp.abs(torque), limit), 1e-9)
    soft = hard * (1.0 + share ** (1.0 / softness)) ** -softness
    return jnp.where(values["softness"] > 0, soft, hard), memory


def _torque_speed(values, torque, now, memory):
    """torque' = clip(torque, min(-limit - c speed, 0), max(limit - c speed, 0)), a DC motor's torque-speed line.

    The limit is the controller's, less the share of it that the motor lacks at the stall. That share is negative where
    the motor could give more than its controller allows, so that the line begins to bind at some speed. c is what the
    back electromotive force takes. Beyond the speed at which nothing is left the motor gives no torque; it does not
    brake on its own.
    """
    drop = values["nm_s_per_rad"] * now.speed
    limit = now.limit * (1.0 - values["stall_loss"])
    low, high = jnp.minimum(-limit - drop, 0.0), jnp.maximum(limit - drop, 0.0)
    # A motor that is off has a limit of zero. The line alone would then brake or drive the joint.
    there = (values["nm_s_per_rad"] > 0) & (now.limit > 0)
    return jnp.where(there, jnp.clip(torque, low, high), torque), memory


def _command_delay(values, target, now, memory):
    """target'(t) = target(t - seconds)."""
    return delayed(memory, target, values["seconds"], now.dt)


def _last_target(values, targets, dt):
    """Starts a delay line of the last of past targets [past, joints]."""
    return delay_line(values, jnp.atleast_2d(targets)[-1], dt)


def _target_slew(values, target, now, memory):
    """A target that moves at `rate` at most, and takes `ramp_s` seconds to reach that speed; `values` hold 1 / rate.

    Of a target that stays, a ramp makes the trapezoid of a drive's profile: target' speeds up with the acceleration
    rate / ramp_s, moves at the rate, and slows down so that it ends at rest. Without one it is

        d target' / dt = clip((target - target') / dt, -rate, rate).
    """
    memory = _nearer(values, memory, target, now.dt)
    return memory[0], memory


def _nearer(values, limited, target, dt):
    """Limited targets and their speeds [2, joints], after a step."""
    inverse = jnp.maximum(values["rad_per_s"], 1e-9)
    far = target - limited[0]
    ramps = (values["rad_per_s"] > 0) & (values["ramp_s"] > 0)
    acceleration = 1.0 / (inverse * jnp.maximum(values["ramp_s"], 1e-9))
    # How fast it may be to come to rest at the target in whole steps: speed^2 + speed acceleration dt = 2 acceleration
    # distance.
    step = 0.5 * acceleration * dt
    brakes = jnp.sqrt(step**2 + 2.0 * acceleration * jnp.abs(far)) - step
    most = jnp.where(ramps, jnp.minimum(1.0 / inverse, brakes), 1.0 / inverse)
    change = jnp.where(ramps, acceleration * dt, jnp.inf)
    moved = jnp.clip(jnp.clip(far, -dt * most, dt * most), dt * (limited[1] - change), dt * (limited[1] + change))
    return jnp.stack([limited[0] + moved, moved / dt])


def _followed(values, targets, dt):
    """Starts with a limited target that has followed past targets [past, joints] from the first of them."""
    del dt
    targets = jnp.atleast_2d(targets)
    # Takes time only where there is a limit.
    begin = jnp.where((values["rad_per_s"] > 0).any(), 1, len(targets))
    steps = jnp.diff(PAST_TARGET_S, prepend=PAST_TARGET_S[0])
    follow = lambda index, limited: _nearer(values, limited, targets[index], steps[index])  # noqa: E731
    start = jnp.where(values["rad_per_s"] > 0, targets[0], targets[-1])
    return jax.lax.fori_loop(begin, len(targets), follow, jnp.stack([start, jnp.zeros_like(start)]))


def _deadband(values, error, now, memory):
    """error' = sign(error) max(|error| - width / 2, 0)."""
    del now
    return jnp.sign(error) * jnp.maximum(jnp.abs(error) - 0.5 * values["rad"], 0.0), memory


def _torque_lag(values, torque, now, memory):
    """seconds d torque' / dt = torque - torque', or two such lags whose times add up to `seconds`."""
    first, second = two_stages(values["seconds"], values["second_stage"])
    between, memory_1 = lagged(memory[0], torque, first, now.dt)
    torque, memory_2 = lagged(memory[1], between, second, now.dt)
    return torque, jnp.stack([memory_1, memory_2])


def _steady(values, torque, dt):
    """Starts both lags with a torque that has always been the same."""
    del values, dt
    return jnp.stack([torque, torque])


_HARDEST = 0.02  # softness below which powers leave single precision
_SECONDS = Parameter(name="seconds", bounds=(0.0, LONGEST_S), prior=0.01)
_LAG_SECONDS = Parameter(name="seconds", bounds=(0.0, 0.15), prior=0.01)  # hydraulic drives take 0.1 s

# The order counts within a stage: targets are delayed before they are slewed, torques limited before they lag.
ROWS = (
    Effect(
        name="command_delay",
        enters="command",
        parameters=(_SECONDS,),
        sizes=(0.001, 0.008),
        act=_command_delay,
        start=_last_target,
        forms=(Form("filtered", "torque_lag"),),
        sentence="Targets act later than they are sent.",
        excited_by="steps and a chirp to 10 Hz at two controller gains",
        **_ACTUATOR,
    ),
    Effect(
        name="target_slew",
        enters="command",
        parameters=(
            Parameter(name="rad_per_s", form="reciprocal", scale="speed", bounds=(0.0, 3.0), prior=0.5),
            Parameter(name="ramp_s", bounds=(0.0, 1.0), prior=0.1),
        ),
        sizes=(0.05, 0.6),
        forms=(Form("ramped", "target_slew", ("ramp_s",), screened=True),),
        act=_target_slew,
        start=_followed,
        sentence="The controller limits how fast its target may move.",
        excited_by="steps of two sizes",
        **_ACTUATOR,
    ),
    Effect(
        name="gain_error",
        enters="error",
        parameters=(
            Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.3),
            Parameter(name="within_rad", form="reciprocal", scale="angle", bounds=(0.0, 20.0), prior=3.0),
        ),
        sizes=(0.05,),
        forms=(Form("small_errors", "gain_error", ("within_rad",)),),
        # Of the error, so that damping gains stay.
        act=_gain_error,
        sentence="The controller's proportional gain is not the one that was set.",
        excited_by="postures of low and of high gravity torque at two controller gains",
        **_ACTUATOR,
    ),
    Effect(
        name="deadband",
        enters="error",
        parameters=(Parameter(name="rad", scale="angle", bounds=(0.0, 0.2), prior=0.02),),
        sizes=(0.003, 0.02),
        act=_deadband,
        sentence="The controller ignores small errors.",
        excited_by="slow triangular reversals at two controller gains",
        **_ACTUATOR,
    ),
    Effect(
        name="torque_speed",
        enters="torque",
        parameters=(
            Parameter(name="nm_s_per_rad", scale="motor", bounds=(0.0, 1.0), prior=0.2),
            Parameter(name="stall_loss", bounds=(-2.0, 0.95), prior=0.3),
        ),
        sizes=(0.1, 0.3, 0.5),
        # A motor with a fraction of the declared torque loses little of it with speed; one that could give more than
        # its controller allows loses it faster, from a higher stall.
        forms=(Form("other_stall", "torque_speed", ("stall_loss",), far=True),),
        act=_torque_speed,
        sentence="The faster the motor turns, the less torque it can give.",
        excited_by="saturating steps",
        **_ACTUATOR,
    ),
    Effect(
        name="torque_limit",
        enters="torque",
        parameters=(
            Parameter(name="torque_nm", form="reciprocal", scale="torque", bounds=(0.0, 3.0), prior=0.3),
            Parameter(name="softness", bounds=(0.0, 1.0), prior=0.3),
        ),
        sizes=(0.15, 0.6),
        forms=(Form("soft", "torque_limit", ("softness",)),),
        act=_torque_limit,
        sentence="The motor's torque has a limit that the model does not know.",
        excited_by="saturating steps",
        **_ACTUATOR,
    ),
    Effect(
        name="torque_lag",
        enters="torque",
        parameters=(_LAG_SECONDS, SECOND_STAGE),
        sizes=(0.001, 0.008),
        act=_torque_lag,
        start=_steady,
        forms=(Form("delayed", "command_delay", ("seconds",)),),
        sentence="The motor's torque follows the commanded torque with a lag.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_ACTUATOR,
    ),
    Effect(
        name="torque_scale",
        enters="torque",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.3),),
        sizes=(0.05,),
        act=scaled,
        sentence="The motor gives a fixed share of the commanded torque.",
        excited_by="a motor-off swing beside driven motion, which distinguishes torque from mass",
        **_ACTUATOR,
    ),
)
