"""Reads lists of episodes of any length, as loops in Python collect them, into arrays of one length.

`jaxtune.types.Trajectory.from_episodes` says what an episode is; every check names the episode and what was expected.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def joined(episodes: Sequence[Mapping[str, Any]], steps: int | None) -> dict[str, Any]:
    """Joins episodes to the fields of a `Trajectory`, by name.

    Args:
      episodes: as `Trajectory.from_episodes` takes them.
      steps: length of the set; that of the longest episode where None.

    Raises:
      ValueError: as `Trajectory.from_episodes` does.
    """
    if isinstance(episodes, Mapping) or not isinstance(episodes, Sequence):
        raise ValueError(f"episodes: got {type(episodes).__name__}, expected a list of episodes")
    if not episodes:
        raise ValueError("episodes: got none, expected at least one")
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise ValueError(f"steps: got {steps!r}, expected a whole number of at least 1")
    read = [_read_episode(number, episode) for number, episode in enumerate(episodes)]
    obs, action, reward, terminated = zip(*read, strict=True)
    steps = max(map(len, reward)) if steps is None else steps
    for field, values in (("observation", obs), ("action", action)):
        widths = {value.shape[1:] for value in values}
        if len(widths) > 1:
            raise ValueError(f"episodes, {field}: got {len(widths)} widths ({widths}), expected one")

    def padded(values):
        whole = np.zeros((len(values), steps, *values[0].shape[1:]), np.float32)
        for row, value in zip(whole, values, strict=True):
            row[: len(value)] = value[:steps]
        return whole

    obs, action, score = padded(obs), padded(action), padded(reward)
    states = _read_states(episodes, [len(value) for value in reward])
    lived = np.array([min(len(value), steps) for value in reward])
    inside = np.arange(steps) < lived[:, None]
    state = {name: padded(values) for name, values in states.items()}
    numbers = [values.reshape(*inside.shape, -1) for values in (obs, action, score, *state.values())]
    finite = np.all([np.isfinite(values).all(-1) for values in numbers], axis=0)
    alive = inside & np.logical_and.accumulate(finite, axis=1)
    broke = (inside & ~finite).any(axis=1)
    ended = np.array([end and len(value) <= steps for end, value in zip(terminated, reward, strict=True)])
    return {
        "obs": obs,
        "action": action,
        "alive": alive,
        "score": np.where(alive, score, 0.0),
        "fell": ended | broke,
        "not_finite": broke,
        "state": state or None,
    }


def _read_states(episodes: Sequence[Mapping[str, Any]], steps: Sequence[int]) -> dict[str, list[np.ndarray]]:
    """Reads the states of all episodes, [time, ...] each, by name; none where no episode has any."""
    found: dict[str, list[np.ndarray]] = {}
    for number, (episode, count) in enumerate(zip(episodes, steps, strict=True)):
        where, state = f"episode {number}, state", episode.get("state")
        state = {} if state is None else state
        if not isinstance(state, Mapping):
            raise ValueError(f"{where}: got {type(state).__name__}, expected arrays [time, ...] by name")
        if number and set(state) != set(found):
            got, wanted = (", ".join(sorted(names)) or "none" for names in (state, found))
            raise ValueError(f"{where}: got {got}, expected {wanted}, as in episode 0")
        for name, values in state.items():
            try:
                values = np.asarray(values, np.float32)
            except (TypeError, ValueError):
                raise ValueError(f"{where}, {name}: expected numbers of one shape for every step") from None
            sizes = found[name][0].shape[1:] if number else values.shape[1:]
            if values.shape not in ((count, *sizes), (count + 1, *sizes)):
                raise ValueError(f"{where}, {name}: got shape {values.shape}, expected {(count, *sizes)}")
            found.setdefault(name, []).append(values[:count])
    return found


def _read_episode(number: int, episode: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Reads observations, actions, rewards and whether it was terminated, and checks that their lengths agree."""
    keys = ("observation", "action", "reward", "terminated")
    if not isinstance(episode, Mapping):
        raise ValueError(f"episode {number}: got {type(episode).__name__}, expected {', '.join(keys)} by name")
    missing = [key for key in keys if key not in episode]
    if missing:
        raise ValueError(f"episode {number}: got {', '.join(episode)}, expected {', '.join(missing)} as well")
    found = []
    for key in keys[:3]:
        value = episode[key]
        try:
            array = np.asarray(value, np.float32)
        except (TypeError, ValueError):
            raise ValueError(
                f"episode {number}, {key}: expected one list of numbers a step, all of one width"
            ) from None
        if array.size == 0:
            raise ValueError(f"episode {number}, {key}: got no step, expected at least one")
        found.append(array.reshape(len(array), -1) if key != "reward" else array)
    obs, action, reward = found
    if reward.ndim != 1 or len(action) != len(reward) or len(obs) not in (len(reward), len(reward) + 1):
        raise ValueError(
            f"episode {number}: got {len(obs)} observations, {len(action)} actions, rewards of shape {reward.shape}; "
            "expected as many of each (one more observation is allowed)"
        )
    ended = np.asarray(episode["terminated"])
    # An episode ends with the step that terminates it.
    fits = ended.dtype == bool and ended.shape in ((), (len(reward),)) and not np.atleast_1d(ended)[:-1].any()
    if not fits:
        raise ValueError(
            f"episode {number}, terminated: got {ended.dtype} of shape {ended.shape}, expected True or False, for the "
            "episode or for each of its steps, and True in none but the last"
        )
    return obs[: len(reward)], action, reward, bool(ended.any())
