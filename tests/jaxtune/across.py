"""What one, two and four devices compute by the functions that are named, as JSON; some on one and four alone.

It is a process of its own, since devices are made once.
"""

import json
import os
import sys

os.environ["XLA_FLAGS"] = (
    "--xla_force_host_platform_device_count=4 --xla_backend_optimization_level=0 "
    "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
)
os.environ["NPROC"] = "8"

import jax
import jax.numpy as jnp
import numpy as np
import sled

from jaxtune import devices, tuner
from jaxtune import dist as dists
from jaxtune.discovery import simulation
from jaxtune.dvm import DVMConfig
from jaxtune.mjx import TrainingBatch
from jaxtune.ppo import PPO, PPOConfig
from jaxtune.spm import SPMConfig

SIM = sled.simulator()
SIZES = tuner.TunerConfig(
    episodes=30,
    set_episodes=2,
    held_out_sets=19,
    max_widenings=1,
    refinements=0,
    spm=SPMConfig(hidden=(16, 16, 16), head=8, train_steps=3, batch=16),
    dvm=DVMConfig(channels=8, latent=4, train_steps=3, batch=16, references=64),
)


def act(policy, obs, key):
    return policy * jnp.sin(4.0 * obs[:1]) + jax.random.normal(key, (1,))


def episodes():
    """An odd number of them, so that shares are filled up."""
    draws = dists.sample(jax.random.PRNGKey(0), SIM.dist(), 15)
    return SIM.simulate(act)(jax.random.PRNGKey(1), 2.0, draws).obs


def update():
    """Two updates of PPO: the second one is of what the first one made."""
    env = TrainingBatch(SIM, SIM.parameters, 40)
    ppo = PPO(PPOConfig(num_envs=16, unroll_steps=8, epochs=2, minibatches=2, hidden=(8,)), 3, 1)
    state, robots = ppo.init(jax.random.PRNGKey(0)), jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 16))
    step = jax.jit(lambda key, state, robots: ppo.update(key, state, env, robots))
    for number in range(2):
        state, robots, metrics = step(jax.random.PRNGKey(number), state, robots)
    return jax.flatten_util.ravel_pytree((state.params, robots.obs, metrics))[0]


def tunings():
    """A whole tuning, its training left out."""
    machine = tuner.Tuner(config=SIZES, train_policy=tuner.keep, simulate=SIM.simulate(act))
    measured = SIM.measure(act, {"mass": 1.2}, 2)(jax.random.PRNGKey(2), 2.0)
    state = machine.init(2.0, SIM.dist(), tuner.knobs(threshold=0.9))
    state, info = jax.jit(machine.tune)(jax.random.PRNGKey(3), state, measured)
    return jax.flatten_util.ravel_pytree((state.dist, info.gate, info.update))[0]


def lanes():
    """A function that is spread may call one that spreads."""

    def lane(key):
        return SIM.simulate(act)(key, 2.0, {name: jnp.zeros(2) for name in SIM.parameters}).obs

    return jax.jit(lambda keys: devices.in_chunks(lane, (keys,), {"cpu": 1, "other": 1}))(
        jax.random.split(jax.random.PRNGKey(4), 5)
    )


def pairs():
    """Discovery's simulations."""
    from slider import problem

    asked = problem({"coulomb": 0.6})
    return simulation.residuals(asked, np.eye(asked.axes)[:3] * 0.1, asked.data["train"][asked.main_horizon])


# They share by the same two functions as episodes do.
SHARED = {"lanes": (4,), "pairs": (4,)}

found = {}
for function in (globals()[name] for name in sys.argv[1:]):
    found[function.__name__] = [np.asarray(function(), float).ravel().tolist()]
    for count in SHARED.get(function.__name__, (2, 4)):
        with jax.set_mesh(devices.mesh(count)):
            found[function.__name__].append(np.asarray(function(), float).ravel().tolist())
print(json.dumps(found))
