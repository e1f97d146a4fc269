"""The robots that commands work with, by the name that `--robot` takes.

`biteno` and `go2` ship with the package. `playground:NAME` is an environment of MuJoCo Playground, and
`playground-warp:NAME` the same, simulated by MuJoCo Warp.
`path/to/file.py:function` is a robot of one's own: the function returns a `jaxtune.mjx.Simulator`, or an environment,
for which a parameter table is then proposed (`jaxtune.mjx.parameters_of`).
"""

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import corrected, go2, sensing
from envs.biteno import TaskConfig, constants, gait, onboard, walks
from envs.corrected import Correction
from envs.diagnosis import Finding, diagnose_log, shared_findings
from envs.logs import Log, read, read_observed
from envs.targets import observed
from envs.targets.mjx import MjxTarget
from envs.targets.protocol import Target
from envs.targets.recorded import Recorded
from experiments.common.config import WALK, Preset
from experiments.walking.targets import TARGETS
from jaxtune.misfits import Phase, share_of_episode
from jaxtune.mjx import Entry, Robot, Simulator, model_of, parameters_of, select

_IMPLEMENTATIONS = {"playground": "jax", "playground-warp": "warp"}  # of MJX, for environments of Playground
_LONGEST = 1000  # control steps of an episode, where the robot is an environment alone


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What the commands need to know of one robot."""

    name: str
    """As `--robot` names it."""
    entries: Mapping[str, Entry]
    """Every parameter that can be tuned, by name."""
    sets: Mapping[str, tuple[str, ...]]
    """Sets of parameters by the name that `--parameters` takes; the first is its default."""
    make: Callable[[Preset, Mapping[str, Entry], Correction | None], Robot]
    """Makes robot and task with a parameter table, as they are simulated and measured."""
    engines: Mapping[str, Callable[[Robot, Mapping[str, float]], Target]]
    """Targets by engine, `(robot, physical values) -> target`."""
    control_s: float
    """Control period in seconds."""
    power: Callable[[Any], jax.Array]
    """Mechanical power in W, from what a robot's `move` returns beside its state."""
    meta: Callable[[Preset, Robot], dict]
    """What the robot's computer must know around an exported policy, as JSON."""
    read: Callable[[Path], Log]
    """Reads a log of the robot, and checks it."""
    episodes: Callable[[Log, int], Recorded]
    """Makes episodes of as many control steps of a log."""
    findings: Callable[[Log], list[tuple[Finding, list[str]]]]
    """What the log doctor suspects, with the names of the runs that share it."""
    episode_steps: int
    """Control steps of an episode; a preset may have fewer."""
    phase: Phase = share_of_episode
    """Where in its gait's cycle a step is."""
    trained: Callable[[Preset], Preset] = lambda preset: preset
    """Changes the preset of the robots that a policy trains on."""
    config: Callable[[Preset], dict] = lambda preset: {}
    """Settings that a saved policy depends on, beside the network's."""
    shown: Mapping[str, Mapping[str, str]] = field(default_factory=lambda: {"per second": {"reward": "reward"}})
    """Metrics that a training curve shows: names by label, by panel."""
    player: Path | None = None
    """A file that is exported beside a policy, to run it on the robot's computer."""
    policy: Path | None = None
    """Folder of a policy that ships with the robot."""
    digest: str | None = None
    """SHA-256 of a robot's own file and model, which may change behind the same name; None for those that ship."""

    @property
    def identity(self) -> dict[str, str]:
        """What the config of a run says of the robot beside its name, so that none goes on with another robot."""
        return {} if self.digest is None else {"robot_sha256": self.digest}

    def chosen(self, parameters: str | None) -> dict[str, Entry]:
        """Returns the rows of the robot's parameter table that `--parameters` names.

        Args:
          parameters: the name of a set, names of parameters joined by commas, or None for the robot's first set.

        Returns:
          The rows (`jaxtune.mjx.Entry`) by name, in the order given.

        Raises:
          ValueError: a name is neither; the message lists those that exist.
        """
        if parameters is None:
            parameters = next(iter(self.sets))
        names = self.sets.get(parameters) or tuple(name.strip() for name in parameters.split(","))
        return select(self.entries, names)


def kind(name: str) -> Kind:
    """Returns the robot that `--robot` names.

    Raises:
      ValueError: there is no such robot, file or function, or the function returns something else.
    """
    if name in _SHIPPED:
        return _SHIPPED[name]()
    place, colon, what = name.rpartition(":")
    if colon and place in _IMPLEMENTATIONS:
        # The policies of one are the other's.
        return _foreign(name, _playground(name, what, _IMPLEMENTATIONS[place]), saved=f"playground:{what}")
    if colon and place.endswith(".py"):
        if not Path(place).is_file():
            raise ValueError(f"robot: {place} does not exist")
        path = Path(place).resolve()
        robot = _foreign(name, made := _from_file(path, what), saved=f"{path.name}:{what}")
        return replace(robot, digest=_digest(path, made))
    raise ValueError(
        f"robot: got '{name}', expected {', '.join(_SHIPPED)}, playground:NAME, playground-warp:NAME or "
        "path/to/file.py:function"
    )


def _foreign(name: str, made: Any, saved: str = "") -> Kind:
    """Makes a kind of a simulator, or of an environment without a table; policies call it `saved`, where given."""
    try:
        if not isinstance(made, Simulator):
            table = parameters_of(model_of(made), control_s=float(getattr(made, "dt", 0.0)))
            made = Simulator(made, _LONGEST, table, observe=_state_key(made))
        if not hasattr(made.env, "dt"):
            raise ValueError("env: has no dt, the control period in seconds")
    except ValueError as error:
        raise ValueError(f"robot '{name}': {error}") from error
    return Kind(
        name=name,
        entries=made.parameters,
        sets={"all": tuple(made.parameters)},
        make=lambda preset, entries, correction: _uncorrected(replace(made, parameters=entries), correction),
        engines={"mjx": lambda robot, params: MjxTarget(robot=robot, params=params)},
        control_s=float(made.env.dt),
        power=_power,
        config=lambda preset: {"robot": saved or name},
        meta=lambda preset, robot: {
            "robot": name,
            "rate_hz": 1.0 / float(robot.env.dt),
            "observation": [{"name": part, "size": size} for part, size in robot.layout.items()],
            "action": robot.action_size,
        },
        read=read_observed,
        episodes=partial(
            observed.episodes, control_s=float(made.env.dt), obs=made.observation_size, act=made.action_size
        ),
        findings=lambda log: [],
        episode_steps=made.steps,
    )


def _digest(path: Path, made: Any) -> str:
    """A SHA-256 of a file and of the model that its robot has: the file may read it from another one."""
    found = hashlib.sha256(path.read_bytes())
    model = getattr(made, "model", None)
    for leaf in jax.tree.leaves(model_of(made) if model is None else model):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


def _state_key(env: Any) -> str | None:
    """Returns the key of what a policy is given in Playground's dictionaries of observations."""
    obs = getattr(jax.eval_shape(env.reset, jax.random.PRNGKey(0)), "obs", None)
    return "state" if isinstance(obs, Mapping) and "state" in obs else None


def _uncorrected(robot: Simulator, correction: Correction | None) -> Simulator:
    if correction is not None:
        raise ValueError("model: got a corrected model, which can be simulated with --robot biteno alone")
    return robot


def _power(state: Any) -> jax.Array:
    """Mechanical power of the joints in W, from the state of an environment of Playground or Brax; else nan."""
    data = getattr(state, "data", None) or getattr(state, "pipeline_state", None)
    return jnp.full((), jnp.nan) if data is None else jnp.maximum(data.qfrc_actuator * data.qvel, 0.0).sum()


def _playground(robot: str, name: str, impl: str) -> Any:
    try:
        from mujoco_playground import registry
    except ModuleNotFoundError as error:
        raise ValueError("robot: MuJoCo Playground is not installed; expected `pip install playground`") from error
    if name not in registry.ALL_ENVS:
        raise ValueError(f"robot: got '{robot}', expected one of {', '.join(registry.ALL_ENVS)}")
    # Some environments have no such setting, and one implementation.
    has_choice = "impl" in registry.get_default_config(name)
    if impl == "warp":
        if not has_choice:
            raise ValueError(f"robot: got '{robot}', expected 'playground:{name}', which has no other implementation")
        # The contacts of all robots are in one array, which devices cannot share.
        if len(jax.devices()) > 1:
            raise ValueError(
                f"robot: got '{robot}' on {len(jax.devices())} devices, expected one: set CUDA_VISIBLE_DEVICES=0, or "
                "on a CPU XLA_FLAGS=--xla_force_host_platform_device_count=1"
            )
    return registry.load(name, config_overrides={"impl": impl} if has_choice else None)


@cache
def _from_file(path: Path, function: str) -> Any:
    # As for a script: its folder is searched for what it imports, and its classes find their module by name. The name
    # is its own, or `brax.py` would stand in the place of Brax.
    sys.path.append(str(path.parent))
    name = f"_robot_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    make = getattr(module, function, None)
    if not callable(make):
        raise ValueError(f"robot: {path} has no function '{function}'")
    if any(parameter.default is parameter.empty for parameter in inspect.signature(make).parameters.values()):
        raise ValueError(f"robot: {path}: got {function}{inspect.signature(make)}, expected a function of no arguments")
    return make()


BITENO = Kind(
    name="biteno",
    entries=constants.ENTRIES,
    sets=constants.PARAMETER_SETS,
    make=lambda preset, entries, correction: corrected.make(preset.task, entries, correction),
    engines=TARGETS,
    control_s=constants.POLICY_DT_S,
    episode_steps=round(TaskConfig().episode_s / constants.POLICY_DT_S),
    power=lambda motion: gait.power(motion.torque, motion.qvel[6:]),
    phase=lambda episodes: sensing.phase(episodes.obs),
    trained=lambda preset: replace(preset, task=replace(preset.task, push_mps=preset.push_mps)),
    config=lambda preset: {"base": preset.task.base, "action_scale": preset.task.action_scale},
    meta=lambda preset, robot: onboard.meta(preset.task),
    shown={
        "per second": {"trained reward": "reward", "Table I": "score"},
        "share": {
            "linear tracking": "linear_tracking",
            "angular tracking": "angular_tracking",
            "feet in step with the clock (of 2)": "clock_contact",
        },
    },
    read=read,
    episodes=walks.episodes,
    findings=lambda log: shared_findings(diagnose_log(log)),
    player=Path(onboard.__file__).with_name("player.py"),
    policy=WALK,
)
"""The paper's biped."""

_SHIPPED = {"biteno": lambda: BITENO, "go2": lambda: _foreign("go2", go2.simulator())}
