"""Checks of the episodes that a user's functions return: by shape, so they run before anything is compiled."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np

from jaxtune.settings import TunerConfig
from jaxtune.types import Trajectory


def check_simulated(trajectory: Trajectory, episodes: int, config: TunerConfig) -> None:
    """Checks what `simulate` returns.

    Args:
      trajectory: episodes, or their shapes from `jax.eval_shape`.
      episodes: number of draws that `simulate` was given.
      config: sizes of the tuning.

    Raises:
      ValueError: a field has another shape than `Trajectory` says, or an episode is shorter than a window.
    """
    steps = _check_shapes("simulate", trajectory, episodes, "one per draw of the coordinates")
    window = config.longest_window
    if steps < window:
        raise ValueError(
            f"simulate: got episodes of {steps} steps, expected at least {window}, the length of a window "
            "(SPMConfig.window, DVMConfig.window, RegressionConfig.window)"
        )


def check_set(measured: Trajectory, config: TunerConfig) -> int:
    """Checks a measured set by itself, before anything is simulated; returns the number of its steps.

    Raises:
      ValueError: the set has another number of episodes than `config.set_episodes`, or a field another shape than
        `Trajectory` says.
    """
    return _check_shapes("measured", measured, config.set_episodes, "TunerConfig.set_episodes")


def check_measured(measured: Trajectory, simulated: Trajectory, config: TunerConfig) -> None:
    """Checks a measured set against the simulated episodes that it will be compared with.

    Args:
      measured: the measured set, or its shapes.
      simulated: what `simulate` returns, or its shapes.
      config: sizes of the tuning.

    Raises:
      ValueError: as `check_set`; episodes, observations or actions are of another size than the simulated ones; or,
        where values are known, no simulated observation ever changes.
    """
    steps = check_set(measured, config)
    expected = np.shape(simulated.alive)[1]
    if steps != expected:
        raise ValueError(
            f"measured: got episodes of {steps} steps, expected {expected}, as simulated; what makes sets of episodes "
            "of many lengths (`from_episodes`, `one_by_one`) takes `steps`"
        )
    for field in ("obs", "action"):
        got, expected = np.shape(getattr(measured, field))[-1], np.shape(getattr(simulated, field))[-1]
        if got != expected:
            raise ValueError(f"measured, {field}: got {got} numbers a step, expected {expected}, as simulated")
    _check_motion(simulated)


def _check_motion(simulated: Trajectory) -> None:
    """Checks that something is observed, where values are known: inside `jit` the gate finds it instead."""
    obs = simulated.obs
    if isinstance(obs, jax.core.Tracer | jax.ShapeDtypeStruct):
        return
    seen = np.asarray(obs)[np.asarray(simulated.alive)]
    if len(seen) and (seen == seen[0]).all():
        raise ValueError(
            f"simulate, obs: got {seen.shape[-1]} numbers that are the same in every step of every episode, expected "
            "some that show how the robot moves"
        )


def check_states(measured: Trajectory, simulated: Trajectory, config: TunerConfig, needs: Sequence[str] = ()) -> None:
    """Checks that a set can be simulated again from its states (`jaxtune.replay`).

    Args:
      measured: the measured set, [episodes, time], or its shapes.
      simulated: what `simulate` returns, or its shapes.
      config: sizes of the tuning.
      needs: names that a measured state must have.

    Raises:
      ValueError: one of them has no states, a measured state lacks a name, or has one or a shape that simulated ones
        have not, episodes are no longer than a piece, or there are fewer held-out sets than are to be fitted.
    """
    for source, episodes in (("measured", measured), ("simulate", simulated)):
        if not isinstance(episodes.state, Mapping) or not episodes.state:
            raise ValueError(f"{source}, state: got none, expected arrays by name, since the tuner has a replay")
    missing = sorted(set(needs) - set(measured.state))
    if missing:
        raise ValueError(f"measured, state: got {', '.join(measured.state)}, expected '{missing[0]}' as well")
    unknown = sorted(set(measured.state) - set(simulated.state))
    if unknown:
        raise ValueError(f"measured, state: got '{unknown[0]}', expected some of {', '.join(simulated.state)}")
    for name, values in measured.state.items():
        for got, expected in zip(jax.tree.leaves(values), jax.tree.leaves(simulated.state[name]), strict=True):
            shape = (*np.shape(measured.alive), *np.shape(expected)[np.ndim(simulated.alive) :])
            if np.shape(got) != shape:
                raise ValueError(f"measured, state, {name}: got shape {np.shape(got)}, expected {shape}")
    if not 1 <= config.replay.sets <= config.held_out_sets:
        raise ValueError(
            f"ReplayConfig.sets: got {config.replay.sets}, expected 1 to {config.held_out_sets} held-out sets"
        )
    steps = np.shape(measured.alive)[1]
    if steps <= config.replay.window:
        raise ValueError(
            f"measured: got episodes of {steps} steps, expected more than {config.replay.window}, the length of a "
            "piece (ReplayConfig.window)"
        )


def _check_shapes(source: str, trajectory: Trajectory, episodes: int, why: str) -> int:
    """Checks every field of a trajectory, and returns the number of its steps."""
    if not isinstance(trajectory, Trajectory):
        raise ValueError(
            f"{source}: got {type(trajectory).__name__}, expected a jaxtune.types.Trajectory (Trajectory.from_episodes "
            "makes one of lists)"
        )
    for field in ("alive", "fell", "not_finite"):
        value = getattr(trajectory, field)
        kind = getattr(value, "dtype", type(value).__name__)
        if kind != np.dtype(bool):
            raise ValueError(f"{source}, {field}: got {kind}, expected an array of bool")
    for field in ("obs", "action"):
        value = getattr(trajectory, field)
        if not hasattr(value, "shape"):
            names = f" of {', '.join(map(str, value))}" if isinstance(value, dict) else ""
            raise ValueError(
                f"{source}, {field}: got a {type(value).__name__}{names}, expected one array "
                f"[episodes, time, {field}]: put what is to be compared side by side"
            )
        if value.dtype == np.dtype(bool):
            raise ValueError(f"{source}, {field}: got bool, expected numbers, such as 0 and 1 of float32")
    shape = np.shape(trajectory.alive)
    if len(shape) != 2 or shape[0] != episodes:
        raise ValueError(f"{source}, alive: got shape {shape}, expected {episodes} episodes ({why}) by time")
    for field in ("obs", "action", "score", "fell", "not_finite"):
        got = np.shape(getattr(trajectory, field))
        expected = [*shape[:1]] if field in ("fell", "not_finite") else [*shape]
        channels = field in ("obs", "action")
        if [*(got[:-1] if channels else got)] != expected:
            raise ValueError(f"{source}, {field}: got shape {got}, expected {(*expected, *[field] * channels)}")
    return shape[1]
