"""A small world with known truth, and sizes of the tuner that suit it."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxtune import dist as dists
from jaxtune import dvm, spm
from jaxtune.dvm import DVMConfig
from jaxtune.shooting import Replay
from jaxtune.spm import SPMConfig
from jaxtune.tuner import Collected, TunerConfig
from jaxtune.types import ParamDist, Trajectory

# Small enough for seconds on a CPU, large enough to find what the slider shows.
SPM = SPMConfig(
    window=50, stride=5, hidden=(128, 64, 64), head=16, train_steps=600, batch=96, guesses=4,
    learning_rate=3e-3, weight_decay=1e-3, sweep=17,
)  # fmt: skip
DVM = DVMConfig(
    window=50, stride=5, latent=6, channels=16, train_steps=300, batch=64, learning_rate=3e-3, references=512,
    neighbours=5, reach=0.95,
)  # fmt: skip
TUNER = TunerConfig(
    episodes=512, set_episodes=3, held_out_sets=39, max_widenings=4, coverage=0.9, min_radius=0.05,
    spm=SPM, dvm=DVM,
)  # fmt: skip

# For tests of the bookkeeping, in which nothing needs to be learned.
TINY_SPM = SPMConfig(
    window=50, stride=10, hidden=(8, 8, 8), head=4, train_steps=4, batch=8, guesses=2,
    learning_rate=1e-3, weight_decay=1e-3, sweep=5,
)  # fmt: skip
TINY_DVM = DVMConfig(
    window=50, stride=10, latent=2, channels=4, train_steps=4, batch=8, learning_rate=1e-3, references=32,
    neighbours=3, reach=0.95,
)  # fmt: skip
TINY = TunerConfig(
    episodes=8, set_episodes=2, held_out_sets=19, max_widenings=2, coverage=0.9, min_radius=0.05,
    spm=TINY_SPM, dvm=TINY_DVM,
)  # fmt: skip

long_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})
"""For what trains: compiled better than the rest of the tests (see conftest), and still faster than by default."""

# One compilation for all tests of the same sizes.
train_spm = long_jit(spm.train, static_argnums=1)
train_dvm = long_jit(dvm.train, static_argnums=1)


@dataclass(frozen=True, kw_only=True)
class Slider:
    """A mass on a spring, pushed by a force of two tones: `mass v' = force - friction v - stiffness x + wind`.

    Coordinates are `mass` and `friction`, logarithms of multipliers of 1 kg and 1 Ns/m, and where it is named a steady
    `wind` in N: no mass and no friction moves the point of rest, so they cannot stand in for it. Other names enter
    nowhere. Observed are position and velocity, with noise. The tones surround the resonance of the nominal slider
    (2 rad/s), so mass and friction show within any 2.5 s.
    """

    steps: int = 60
    noise: float = 0.02
    """Standard deviation of both observations."""

    dt = 0.05
    stiffness = 4.0
    tones = (1.5, 4.0)

    @functools.partial(jax.jit, static_argnames="self")
    def simulate(self, key: jax.Array, policy: Mapping, coords: Mapping) -> Trajectory:
        """One episode for every draw of the coordinates, [episodes] by name."""
        count = coords["mass"].shape[0]
        return jax.vmap(lambda key, coords: self._episode(key, policy, coords))(jax.random.split(key, count), coords)

    def measure(self, truth: Mapping, count: int):
        """The function that measures `count` episodes of a slider with these parameters."""
        coords = {name: jnp.full(count, value, jnp.float32) for name, value in truth.items()}
        return lambda key, policy: self.simulate(key, policy, coords)

    def _episode(self, key, policy, coords):
        key_start, key_noise = jax.random.split(key)
        time = self.dt * jnp.arange(self.steps)
        force = policy["amplitude"] * jnp.sin(jnp.outer(time, jnp.array(self.tones))).sum(axis=-1)
        start = 0.05 * jax.random.normal(key_start, (2,))
        _, clean = jax.lax.scan(lambda state, force: (self.move(state, force, coords), state), start, force)
        read = clean + self.noise * jax.random.normal(key_noise, clean.shape)
        return Trajectory(
            obs=read,
            action=force[:, None],
            alive=jnp.ones(self.steps, bool),
            score=1.0 - clean[:, 0] ** 2,
            fell=jnp.asarray(False),
            not_finite=jnp.asarray(False),
            state={"slider": read},
        )

    def move(self, state, force, coords):
        """One step from a state, position and velocity, under a force."""
        mass, friction, wind = jnp.exp(coords["mass"]), jnp.exp(coords["friction"]), coords.get("wind", 0.0)
        position, velocity = state
        push = force + wind - friction * velocity - self.stiffness * position
        velocity = velocity + self.dt * push / mass
        return jnp.stack([position + self.dt * velocity, velocity])

    def replay(self) -> Replay:
        """Pieces of an episode from measured positions and velocities."""

        def play(state, actions, coords):
            move = lambda now, force: (self.move(now, force[0], coords), None)  # noqa: E731
            return jax.lax.scan(move, state["slider"], actions)[0]

        return Replay(play=play, read=lambda state: state["slider"])


def policy() -> dict:
    """The untrained policy of the slider."""
    return {"amplitude": jnp.ones(()), "rounds": jnp.zeros(())}


def train_policy(key, policy, dist):
    """Counts its calls; the force stays what it is, so that episodes of all tunings compare."""
    rounds = policy["rounds"] + 1
    return {**policy, "rounds": rounds}, {"rounds": rounds}


def uniform(centre: Mapping, radius: float = 0.4, bound: float = 1.2) -> ParamDist:
    """A distribution within `[-bound, bound]` for every parameter."""

    def everywhere(value):
        return {name: jnp.float32(value) for name in centre}

    centre = {name: jnp.float32(value) for name, value in centre.items()}
    return dists.make(centre, radius, everywhere(-bound), everywhere(bound))


def collect(key: jax.Array, dist: ParamDist, config: TunerConfig = TUNER) -> Collected:
    """Simulated episodes of one distribution, as the gate and an update see them."""
    key_coords, key_held_out, key_simulate = jax.random.split(key, 3)
    coords = dists.sample(key_coords, dist, config.episodes)
    truths = dists.sample(key_held_out, dist, config.held_out_sets)
    each = {name: jnp.repeat(value, config.set_episodes) for name, value in truths.items()}
    held_out = Slider().simulate(jax.random.fold_in(key_simulate, 1), policy(), each)
    shape = config.held_out_sets, config.set_episodes
    return Collected(
        trajectory=Slider().simulate(key_simulate, policy(), coords),
        sampled_coords=coords,
        held_out=jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), held_out),
        held_out_coords=truths,
        dist=dist,
    )


def simulated(centre: Mapping, count: int):
    """Episodes of robots drawn around a centre, their coordinates, and what they were drawn from."""
    dist = uniform(centre)
    coords = dists.sample(jax.random.key(0), dist, count)
    return Slider().simulate(jax.random.key(1), policy(), coords), coords, dist


def measured(centre: Mapping, episodes: int = 3, **radii) -> Trajectory:
    """A set of a slider that is so many radii off the centre."""
    truth = {name: value + 0.4 * radii.get(name, 0.0) for name, value in centre.items()}
    return Slider().measure(truth, episodes)(jax.random.key(3), policy())
