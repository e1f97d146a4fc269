"""BITeno with what discovery found, against BITeno whose model says the same."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import corrected, correction, models
from envs.biteno import Biteno, BraxBiteno, CorrectedBiteno, TaskConfig, constants
from envs.correction import Correction
from envs.domain import select

ENTRIES = select(constants.ENTRIES, ("torque_scale",))
STEPS = 20


def robot(**effects):
    return CorrectedBiteno(TaskConfig(), ENTRIES, Correction(constants.MODEL_PATH, effects))


def walk(biteno, torque_scale=1.0, steps=STEPS):
    """States [steps] of an episode under actions that wander."""
    params = {"torque_scale": jnp.float32(torque_scale)}
    actions = jax.random.uniform(jax.random.key(1), (steps, 6), minval=-1.0)

    @jax.jit
    def play(key):
        start = biteno.reset(params, key)

        def step(state, action):
            state = biteno.step(params, state, action)
            return state, state

        return start, jax.lax.scan(step, start, actions)[1]

    return play(jax.random.key(0))


@pytest.fixture(scope="module")
def plain():
    return walk(Biteno(TaskConfig(), ENTRIES))


everywhere = partial(dict.fromkeys, constants.JOINTS)


def test_without_effects_it_is_the_robot_that_it_was(plain):
    start, states = walk(robot())
    np.testing.assert_allclose(start.obs, plain[0].obs, atol=1e-6)
    np.testing.assert_allclose(states.qpos, plain[1].qpos, atol=2e-4)
    np.testing.assert_allclose(states.score, plain[1].score, atol=2e-3)


def test_a_weak_motor_is_weak_whoever_says_so():
    _, states = walk(robot(torque_scale=everywhere({"ratio": 0.6})))
    _, expected = walk(Biteno(TaskConfig(), ENTRIES), torque_scale=0.6)
    np.testing.assert_allclose(states.qpos, expected.qpos, atol=2e-4)
    # And once more by what is tuned: 0.6 of 0.6.
    _, weaker = walk(robot(torque_scale=everywhere({"ratio": 0.6})), torque_scale=0.6)
    _, expected = walk(Biteno(TaskConfig(), ENTRIES), torque_scale=0.36)
    np.testing.assert_allclose(weaker.qpos, expected.qpos, atol=2e-4)


def test_a_late_command_moves_the_robot_late(plain):
    late = {"command_delay": everywhere({"seconds": 0.01})}
    _, states = walk(robot(**late), steps=3)
    assert np.abs(states.qpos[:, 7:] - plain[1].qpos[:3, 7:]).max() > 1e-3


def test_a_biased_encoder_is_seen_by_the_policy_and_by_the_controller(plain):
    start, states = walk(robot(encoder_bias={"left_knee": {"rad": 0.05}}))
    knee = constants.JOINTS.index("left_knee")
    read = np.asarray(states.obs[:, 12 + knee]) + constants.STAND_RAD[knee]
    np.testing.assert_allclose(read, states.qpos[:, 7 + knee] + 0.05, atol=1e-5)
    np.testing.assert_allclose(start.obs[12 + knee] - plain[0].obs[12 + knee], 0.05, atol=1e-5)
    # The controller takes the knee to where it reads the target.
    assert (states.qpos[5:10, 7 + knee] < plain[1].qpos[5:10, 7 + knee]).all()


def test_it_trains_behind_braxs_interface():
    effects = {"torque_lag": everywhere({"seconds": 0.01}), "backlash": {"left_hip": {"rad": 0.02}}}
    env = BraxBiteno(robot(**effects, load_friction=everywhere({"ratio": 0.1})))
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    state = jax.jit(env.step)(state, jnp.zeros((3, 6)))
    assert np.isfinite(state.obs).all()
    assert not state.done.any()


def test_what_discovery_wrote_is_read(tmp_path):
    from envs.rig import Rig

    rig = Rig(models.spec("biteno"), constants.JOINTS, 1000.0)
    effects = {"command_delay": {"right_hip": {"seconds": 0.004}}, "coulomb": {"left_knee": {"torque_nm": 0.7}}}
    corrected.save(tmp_path, models.spec("biteno"), rig, corrected.coordinates(rig, effects))
    read = correction.read(tmp_path)
    assert set(read.effects) == {"command_delay"}
    biteno = CorrectedBiteno(TaskConfig(), ENTRIES, read)
    knee = biteno.joint_dof[constants.JOINTS.index("left_knee")]
    np.testing.assert_allclose(biteno.mj_model.dof_frictionloss[knee], 0.7, rtol=1e-6)
    _, states = walk(biteno, steps=2)
    assert np.isfinite(states.qpos).all()


def test_an_unknown_effect_or_place_is_refused_by_name(tmp_path):
    (tmp_path / "effects.json").write_text(json.dumps({"effects": {"gremlins": {}}}))
    with pytest.raises(ValueError, match="gremlins"):
        correction.read(tmp_path)
    with pytest.raises(ValueError, match="third_knee"):
        robot(encoder_bias={"third_knee": {"rad": 0.1}})
