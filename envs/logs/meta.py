"""Reads `meta.yaml` and checks it key by key, before a run is read.

`envs/logs/README.md` describes the keys.
"""

import difflib
import re
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from envs.logs.containment import check_inside, check_model
from envs.logs.controller import BETWEEN_ROWS, FOLLOWING_HZ, GAINS, OPTIONAL_GAINS, Controller
from envs.logs.format import (
    FACTS,
    JOINT_SIGNALS,
    MEASURED,
    OBSERVATION,
    SCALAR_SIGNALS,
    SPLITS,
    VECTOR_SIGNALS,
    Convention,
    alike,
    column_names,
    is_observation,
)

_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}  # factors to rad
_FASTEST_HZ = 1e5  # of rows and controllers; what follows from a rate must fit into memory
_STRONGEST = 1e7  # gains and torque limits: beyond what any robot has, in any unit
_LARGEST = 1e300  # YAML's integers may be too large for a float
_TORQUE = {"Nm": 1.0, "mNm": 1e-3}  # factors to Nm
_META = {
    "robot": True,
    "base": True,
    "rate_hz": True,
    "joints": True,
    "controller": True,
    "signals": False,
    "units": False,
    "sign": False,
    "columns": False,
    "policy": False,
    "runs": False,
}  # key: whether it must be there


_short = reprlib.Repr()
"""Shortens values in error messages: a few aliases of YAML can be billions of values."""
_short.maxlevel = 2
_short.maxstring = _short.maxother = _short.maxlong = 200


class _Loader(yaml.SafeLoader):
    """Loads YAML and refuses keys that are there twice, of which the safe loader silently keeps the last."""

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {_short.repr(key)} is there twice", node.start_mark
                )
        return super().construct_mapping(node, deep)


# Python and JSON write 6e-05, which is a number in YAML 1.2 and text in the 1.1 of this parser.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def _is_column(item: tuple[str, Any]) -> bool:
    return "." in item[0]


class Meta:
    """The content of a folder's `meta.yaml`, checked, with defaults filled in.

    Args:
      folder: of the log.
      robots: joints that may be logged, by the name of the built-in robot; None for a log of observations and actions,
        whose robot may have any name, any joints and an unknown controller.
      model: path of an MJCF that the user names in the place of the log's `robot`, which may be anywhere, or the name
        of a built-in robot.

    Raises:
      ValueError: names the file and the key, what was found and what was expected.
    """

    def __init__(self, folder: Path, robots: Mapping[str, Sequence[str]] | None, model: Path | None = None):
        self.path = folder / "meta.yaml"
        if not self.path.is_file():
            raise ValueError(f"{self.path}: there is no such file")
        check_inside(folder, self.path, "meta.yaml")
        try:
            meta = yaml.load(self.path.read_text(encoding="utf-8"), _Loader)
        except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
            # The parser draws the place on several lines.
            raise ValueError(f"{self.path}: {' '.join(str(error).split())}") from error
        meta = self._mapping("", meta, _META if robots is not None else _META | {"base": False, "controller": False})
        self.robot, movable = self._text("robot", meta["robot"]), None
        if model is not None:
            built_in = str(model) in (robots or {})
            self.robot, movable = self._robot(folder, str(model), robots) if built_in else self._read_model(model)
        elif robots is not None:
            self.robot, movable = self._robot(folder, self.robot, robots)
        self.base = self._one_of("base", meta.get("base", "free"), ("fixed", "free"))
        self.rate_hz = self._rate("rate_hz", meta["rate_hz"])
        self.joints = self._names("joints", meta["joints"])
        for joint in self.joints:
            if movable is not None and joint not in movable:
                raise ValueError(f"{self.path}: joints: '{self.robot}' has no '{joint}'; expected {', '.join(movable)}")
        self.convention = self._read_convention(meta, movable)
        self.known = {"t": None, **dict.fromkeys(self._all_columns())}
        # An observation has as many columns as the log says.
        named = meta["columns"] if isinstance(meta.get("columns"), dict) else {}
        self.known |= {ours: None for ours in named if is_observation(ours)}
        self.columns = {
            ours: self._text(f"columns.{ours}", theirs)
            for ours, theirs in self._mapping("columns", meta.get("columns"), self.known).items()
        }
        # One column of a file cannot be two signals.
        if len(set(self.columns.values())) < len(self.columns):
            self._refuse("columns", self.columns, "another column of the file for each name")
        self.facts = self._read_facts(meta.get("signals"))
        policy = {"rate_hz": False, "action_scale": False, "base": False}
        self.policy = None
        if meta.get("policy") is not None:
            self.policy = self._mapping("policy", meta["policy"], policy)
            for name, value in self.policy.items():
                check = {"base": self._text, "rate_hz": self._rate}.get(name, self._number)
                check(f"policy.{name}", value)
        # Kept as written, because a run may override single numbers of it.
        self._controller = meta.get("controller")
        self.controller = self._controller and self._read_controller("controller", self._controller)
        runs = meta.get("runs")
        names = dict.fromkeys(runs if isinstance(runs, dict) else ())
        self.runs = {name: self._read_run(name, entry) for name, entry in self._mapping("runs", runs, names).items()}

    def uses(self, name: str) -> bool:
        """Says whether a column of a run's file is read, or would be if its name were not misspelt."""
        signal = name.partition(".")[0].casefold()
        ours = ("t", "reward", OBSERVATION, *JOINT_SIGNALS, *VECTOR_SIGNALS, *SCALAR_SIGNALS)
        misspelt = any(alike(name, column) for column in self._all_columns())
        return signal in ours or misspelt or name in self.columns.values()

    def _read_convention(self, meta: Mapping[str, Any], movable: Mapping[str, bool] | None) -> Convention:
        sign = self._mapping("sign", meta.get("sign"), dict.fromkeys(self.joints))
        signs = np.array([float(self._one_of(f"sign.{joint}", sign.get(joint, 1), (1, -1))) for joint in self.joints])
        units = self._mapping("units", meta.get("units"), {"angle": False, "torque": False})
        angle = _ANGLE[self._one_of("units.angle", units.get("angle", "rad"), _ANGLE)]
        torque = _TORQUE[self._one_of("units.torque", units.get("torque", "Nm"), _TORQUE)]
        # Positions of slide joints are no angles: they are always in m.
        angles = np.array([1.0 if movable and not movable[joint] else angle for joint in self.joints])
        # Actions are not among them: they are the policy's, not the model's.
        factors = dict.fromkeys(("q", "dq", "target"), angles * signs)
        factors |= {"tau": torque * signs, "abs_tau": np.full(len(signs), torque), "current": signs}
        return Convention(units=units, sign=sign, factors=factors)

    def _all_columns(self) -> list[str]:
        signals = (*JOINT_SIGNALS, *VECTOR_SIGNALS, *SCALAR_SIGNALS)
        return [name for signal in signals for name in column_names(signal, self.joints)]

    def _read_facts(self, entry: Any) -> dict[str, dict[str, np.ndarray]]:
        """Reads what is known of signals, [columns] by signal and fact; a column's own entry counts for it."""
        columns = {name: column_names(name, self.joints) for name in MEASURED}
        places = {name: (name, slice(None)) for name in MEASURED} | {
            column: (name, slice(i, i + 1)) for name, own in columns.items() for i, column in enumerate(own) if own[1:]
        }
        read = {}
        # Whole signals come before their columns, whatever their order in the file.
        for place, facts in sorted(self._mapping("signals", entry, dict.fromkeys(places)).items(), key=_is_column):
            signal, index = places[place]
            for name, value in self._mapping(f"signals.{place}", facts, dict.fromkeys(FACTS, False)).items():
                where = f"signals.{place}.{name}"
                zero, negative = name in ("noise_sd", "quantum"), name == "offset_s"
                number = self._number(where, value, zero=zero, negative=negative)
                facts_of = read.setdefault(signal, {})
                facts_of.setdefault(name, np.full(len(columns[signal]), np.nan))[index] = number
        return read

    def _read_run(self, name: str, entry: Any) -> dict:
        where = f"runs.{name}"
        entry = self._mapping(where, entry, {"condition": False, "split": False, "controller": False})
        read = {"controller": self.controller}
        if "condition" in entry:
            read["condition"] = self._text(f"{where}.condition", entry["condition"])
        if "split" in entry:
            read["split"] = self._one_of(f"{where}.split", entry["split"], SPLITS)
        if "controller" in entry:
            override = self._mapping(f"{where}.controller", entry["controller"], None)
            # Another type of controller has other numbers, so it inherits none from the log's own controller.
            base = {} if "type" in override else self._controller or {}
            read["controller"] = self._read_controller(f"{where}.controller", {**base, **override})
        return read

    def _read_controller(self, where: str, entry: Any) -> Controller:
        entry = self._mapping(where, entry, None)
        kind = self._one_of(f"{where}.type", entry.get("type"), GAINS)
        own = {name: name != "torque_limit_nm" for name in GAINS[kind]} | dict.fromkeys(OPTIONAL_GAINS[kind], False)
        rest = {"rate_hz": kind != "unknown", "target_between_rows": False}
        self._mapping(where, entry, {"type": True} | rest | own)
        there = [name for name in own if name in GAINS[kind] or name in entry]
        between = entry.get("target_between_rows", "unknown")
        return Controller(
            kind=kind,
            rate_hz=FOLLOWING_HZ if kind == "unknown" else self._rate(f"{where}.rate_hz", entry["rate_hz"]),
            gains={name: self._gain(f"{where}.{name}", entry.get(name, np.inf), name) for name in there},
            between_rows=self._one_of(f"{where}.target_between_rows", between, BETWEEN_ROWS),
        )

    def _gain(self, where: str, value: Any, name: str) -> np.ndarray:
        if name == "torque_limit_nm" and value is np.inf:
            return np.full(len(self.joints), np.inf)
        values = value if isinstance(value, list) else [value] * len(self.joints)
        if len(values) != len(self.joints):
            self._refuse(where, value, f"one number or {len(self.joints)}, one per joint")
        return np.array([self._at_most(where, one, _STRONGEST, zero=name in ("kp", "kd")) for one in values])

    def _robot(self, folder: Path, name: str, robots: Mapping[str, Sequence[str]]) -> tuple[str, dict[str, bool]]:
        """Resolves a robot to its name or path, and the joints that may be logged, with whether each turns."""
        if name in robots:
            return name, dict.fromkeys(robots[name], True)
        path = folder / name
        if not path.is_file():
            self._refuse("robot", name, f"{', '.join(robots)}, or the path of an MJCF file, relative to {folder}")
        check_model(folder, path, f"{self.path}: robot")
        return self._read_model(path)

    def _read_model(self, path: Path) -> tuple[str, dict[str, bool]]:
        if not path.is_file():
            raise ValueError(f"robot: got {path}, expected an MJCF file")
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ValueError(f"{self.path}: robot: {path}: {error}") from error
        # A column holds one number per joint, which free and ball joints have not.
        turns = {int(mujoco.mjtJoint.mjJNT_HINGE): True, int(mujoco.mjtJoint.mjJNT_SLIDE): False}
        kinds = {model.joint(i).name: int(model.jnt_type[i]) for i in range(model.njnt)}
        return str(path.resolve()), {name: turns[kind] for name, kind in kinds.items() if kind in turns}

    def _names(self, where: str, value: Any) -> tuple[str, ...]:
        if not isinstance(value, list) or not value:
            self._refuse(where, value, "a list of names")
        names = tuple(self._text(where, name) for name in value)
        if len(set(names)) != len(names):
            self._refuse(where, value, "names that differ")
        return names

    def _mapping(self, where: str, value: Any, keys: Mapping[str, bool | None] | None) -> dict:
        """Checks for a mapping with these keys and no others; keys that are True must be there."""
        value = {} if value is None and where else value
        if not isinstance(value, dict):
            self._refuse(where or "the file", value, "a mapping")
        if keys is not None:
            for key in value:
                if key not in keys:
                    near = difflib.get_close_matches(str(key), keys, n=1)
                    hint = f"; did you mean '{near[0]}'?" if near else f"; expected some of {', '.join(keys)}"
                    raise ValueError(f"{self.path}: {where + '.' if where else ''}{key}: there is no such key{hint}")
            for key, needed in keys.items():
                if needed and value.get(key) is None:
                    raise ValueError(f"{self.path}: {where + '.' if where else ''}{key}: is missing")
        return value

    def _text(self, where: str, value: Any) -> str:
        if not isinstance(value, str) or not value:
            self._refuse(where, value, "a text")
        return value

    def _number(self, where: str, value: Any, *, zero: bool = False, negative: bool = False) -> float:
        """Checks for a finite number that is positive or, with `zero`, not negative, or, with `negative`, any."""
        least = -_LARGEST if negative else 0
        # In Python, booleans are integers.
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not least <= value < _LARGEST
            or (value == 0 and not (zero or negative))
        ):
            wanted = "a number" if negative else "a number that is not negative" if zero else "a positive number"
            self._refuse(where, value, wanted)
        return float(value)

    def _at_most(self, where: str, value: Any, most: float, *, zero: bool = False) -> float:
        number = self._number(where, value, zero=zero)
        if number > most:
            self._refuse(where, value, f"at most {most:g}")
        return number

    def _rate(self, where: str, value: Any) -> float:
        return self._at_most(where, value, _FASTEST_HZ)

    def _one_of(self, where: str, value: Any, allowed) -> Any:
        if isinstance(value, bool) or not isinstance(value, str | int) or value not in allowed:
            self._refuse(where, value, f"one of {', '.join(map(str, allowed))}")
        return value

    def _refuse(self, where: str, value: Any, wanted: str):
        raise ValueError(f"{self.path}: {where}: got {_short.repr(value)}, expected {wanted}")
