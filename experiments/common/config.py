"""Presets: sizes of the experiments, and readers of the options that several commands share.

A preset holds every number that decides how long a run takes and how good its result can be. `smoke` runs any command
in seconds to minutes; it shows that the command works, but is too small to tune anything. `cpu` is for two cores,
`gpu` for one data-centre GPU.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from envs.biteno import TaskConfig
from experiments.common.cli import console
from jaxtune.dvm import DVMConfig
from jaxtune.mjx import Entry
from jaxtune.ppo import PPOConfig
from jaxtune.settings import SETS_TO_EXPLAIN
from jaxtune.spm import SPMConfig
from jaxtune.tuner import TunerConfig

WALK = Path(__file__).parents[1] / "policies" / "walk"
"""Folder of the policy that ships with the package, the default of `--policy`."""

QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
"""XLA flags of the preset `smoke` and of the tests: programs that run for seconds are not worth minutes of
compiling."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Sizes of one kind of run: task, PPO, tuner, and how much is simulated and evaluated.

    A run writes its preset into `config.json`. It continues only in a folder whose preset is the same.
    """

    task: TaskConfig = field(default_factory=lambda: TaskConfig(physics="fast", base="raibert"))
    """BITeno's task. `fast` physics has sub-steps of 2 ms (`exact`: 1 ms). With `raibert`, actions are offsets from a
    reference walk; with `stand`, from the standing pose."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Sizes of PPO: environments, rollout length, network."""
    tuner: TunerConfig = field(default_factory=TunerConfig)
    """Sizes of a tuning: simulated episodes, measured episodes, both models."""
    push_mps: float = 0.5
    """Speed of the pushes that the policy trains with, in m/s. Tuning and evaluation have none."""
    policy_radius: float = 0.1
    """Largest radius, in coordinates, of the distribution that the policy trains in. The tuner's may be wider, but a
    policy trained on all of that would be robust to robots that do not exist, at the price of its return."""
    episode_steps: int = 250
    """Policy steps (10 ms each) of a simulated or measured episode that the tuner compares."""
    epochs: int = 30
    """PPO updates in a tuning. Each is one rollout and the gradient steps on it."""
    tunings: int = 5
    """Tunings in a run: verify and update the distribution, then train the policy in it."""
    evaluation_episodes: int = 32
    """Whole episodes, of the robot's own length and at most the task's time limit, that a return is averaged over."""
    scratch_updates: int = 3000
    """PPO updates of a policy trained from scratch."""
    foreseen_episodes: int = 100
    """Episodes simulated to predict falls before a robot walks."""
    chunk: int = 10
    """PPO updates between two lines of progress and of the training curve."""
    sweep: TunerConfig = field(
        default_factory=lambda: TunerConfig(
            episodes=120,
            set_episodes=3,
            held_out_sets=19,
            max_widenings=4,
            spm=SPMConfig(hidden=(64, 64, 64), head=16, train_steps=400, batch=64),
            dvm=DVMConfig(channels=32, train_steps=300, references=512),
        )
    )
    """Sizes of a tuning in a sweep. They are smaller, because many tunings run side by side in one program."""
    sweep_steps: int = 100
    """Policy steps of an episode in a sweep."""
    sweep_tunings: int = 3
    """Tunings of every combination in a sweep."""
    sweep_ppo: PPOConfig = field(default_factory=lambda: PPOConfig(num_envs=64, minibatches=2))
    """Sizes of PPO in a sweep."""
    sweep_epochs: int = 10
    """PPO updates in a tuning of a sweep."""
    sweep_lanes: int = 8
    """Runs of a sweep side by side."""
    xla_flags: str = ""
    """Flags that are added to `XLA_FLAGS`; only `smoke` has some, to compile faster."""

    def for_sweep(self) -> "Preset":
        """The same with the sizes of a sweep in the place of a single run's."""
        return replace(
            self,
            ppo=self.sweep_ppo,
            tuner=self.sweep,
            episode_steps=self.sweep_steps,
            tunings=self.sweep_tunings,
            epochs=self.sweep_epochs,
        )


_TINY = TunerConfig(
    episodes=24,
    set_episodes=2,
    held_out_sets=19,
    max_widenings=1,
    spm=SPMConfig(train_steps=20, batch=16, hidden=(32, 32, 32), head=8),
    dvm=DVMConfig(train_steps=20, batch=16, channels=8, references=64),
)

_SMOKE = Preset(
    task=TaskConfig(physics="fast", base="raibert", episode_s=0.8),
    ppo=PPOConfig(num_envs=16, unroll_steps=8, epochs=1, minibatches=2),
    tuner=_TINY,
    episode_steps=80,
    epochs=2,
    tunings=2,
    evaluation_episodes=_TINY.set_episodes,  # of equal length too, so one program measures and evaluates
    foreseen_episodes=4,
    scratch_updates=2,
    chunk=2,
    sweep=_TINY,
    sweep_steps=80,
    sweep_tunings=2,
    sweep_ppo=PPOConfig(num_envs=16, unroll_steps=8, epochs=1, minibatches=2),
    sweep_epochs=2,
    sweep_lanes=2,
    xla_flags=QUICK_COMPILATION,
)

_LARGE = TunerConfig(
    episodes=4000,
    held_out_sets=199,
    spm=SPMConfig(hidden=(512, 256, 256), train_steps=6000, batch=1024),
    dvm=DVMConfig(channels=128, train_steps=4000, batch=512, learning_rate=2e-3, references=8192),
)

_GPU = Preset(
    task=TaskConfig(physics="exact", base="raibert"),
    ppo=PPOConfig(num_envs=8192, minibatches=8, learning_rate=1e-3, entropy_cost=0.005),
    tuner=_LARGE,
    episode_steps=400,
    epochs=100,
    evaluation_episodes=256,
    scratch_updates=400,
    sweep_ppo=PPOConfig(num_envs=256),
    sweep_lanes=64,
)

PRESETS = {"smoke": _SMOKE, "cpu": Preset(), "gpu": _GPU}
"""Presets by the name that `--preset` takes; the defaults of `Preset` are those of `cpu`."""


def tell_limits(sizes: Preset) -> None:
    """Prints what runs of a size cannot find."""
    sets = sizes.tuner.held_out_sets
    if not sizes.tuner.may_be_unexplained:
        text = f"note: {sets} simulated sets are too few to call a robot unexplained; that takes {SETS_TO_EXPLAIN}"
        console.print(text, highlight=False, soft_wrap=True)


def preset(name: str) -> Preset:
    """Returns the preset that the command line names: `smoke`, `cpu` or `gpu`.

    Raises:
      ValueError: no preset has this name.
    """
    if name not in PRESETS:
        raise ValueError(f"preset: got '{name}', expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


def named_values(option: str, items: Sequence[str], entries: Mapping[str, Entry]) -> dict[str, float]:
    """Parses physical values that an option gives as `name=value`, such as `--start trunk_mass=0.5`.

    Args:
      option: its name, for messages.
      items: what was given.
      entries: the parameter table, with the bounds that values must keep.

    Returns:
      Values by name.

    Raises:
      ValueError: an item is not of this form, its name comes twice or is not in the table, or its value is out of
        bounds.
    """
    found = {}
    for item in items:
        name, _, value = item.partition("=")
        if name in found:
            raise ValueError(f"{option}: got '{name}' twice, expected each once")
        try:
            found[name] = float(value)
        except ValueError:
            raise ValueError(f"{option}: got '{item}', expected name=value") from None
        if name not in entries:
            raise ValueError(f"{option}: got '{name}', expected some of {', '.join(entries)}")
        low, high = entries[name].bounds
        if not low <= found[name] <= high:
            raise ValueError(f"{option}: got '{item}', expected {low:g} to {high:g}")
    return found
