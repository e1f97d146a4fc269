"""A policy's network in NumPy alone: what `policy.npz` of an exported policy holds, for any robot.

    network = Network("policy.npz")
    while running:  # network.meta["rate_hz"] times per second
        action = network(observation)

A robot's computer needs NumPy and a copy of this file, which `python -m experiments.export` writes beside the policy.
"""

import json
import zipfile
import zlib
from pathlib import Path

import numpy as np

_DIGITS = 18
# What readers of archives and of JSON raise. LookupError: something is not there.
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, LookupError, TypeError, ValueError, NotImplementedError)


class Network:
    """A policy's network: a normaliser, then dense layers with ELU in between.

    Args:
      path: of the `.npz` that was exported.

    Raises:
      ValueError: the file is damaged, or holds a number that is not finite.
    """

    def __init__(self, path: str | Path):
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
                text = str(stored["meta"])
                arrays = {name: stored[name] for name in stored.files if name != "meta"}
            self.meta = json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_whole)
            used = {"mean", "std"} | {f"{kind}_{i}" for i in range(self.meta["layers"]) for kind in ("kernel", "bias")}
            wrong = [name for name in sorted(used) if not np.isfinite(arrays[name]).all()]
        except FileNotFoundError:
            raise
        except _DAMAGED as error:
            raise ValueError(f"{path}: is damaged: {error}") from error
        if wrong:
            raise ValueError(f"{path}: {wrong[0]}: got a number that is not finite")
        self._mean, self._std = arrays["mean"], arrays["std"]
        self._layers = [(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(self.meta["layers"])]

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Returns the action [act] for an observation [obs], in the order of `meta["observation"]`.

        Raises:
          ValueError: a component is not finite, and names the part of the observation; or the action is not, for an
            observation that is far too large.
        """
        if not np.isfinite(obs).all():
            names = [row["name"] for row in self.meta["observation"] for _ in range(row["size"])]
            bad = dict.fromkeys(name for name, value in zip(names, obs, strict=True) if not np.isfinite(value))
            raise ValueError(f"{', '.join(bad)}: got a number that is not finite")
        value = (obs - self._mean) / self._std
        for number, (kernel, bias) in enumerate(self._layers):
            value = value @ kernel + bias
            if number + 1 < len(self._layers):
                # ELU. Without the minimum, the exponential would overflow in the branch that `where` discards.
                value = np.where(value > 0, value, np.expm1(np.minimum(value, 0.0)))
        if not np.isfinite(value).all():
            raise ValueError(
                f"action: got a number that is not finite, for observations of up to {np.abs(obs).max():g}"
            )
        return value


def _whole(text: str) -> int:
    """Reads a whole number, of which NumPy can make one of its own."""
    if len(text) > _DIGITS:
        raise ValueError(f"meta: got {len(text)} digits, expected {_DIGITS} at most")
    return int(text)


def _finite(text: str) -> float:
    """Reads a number of the file's description; a limit that is no number would limit nothing."""
    number = float(text)
    if not np.isfinite(number):
        raise ValueError(f"meta: got {text}, expected a number that is finite")
    return number
