"""BITeno with what discovery found, against BITeno whose model says the same."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import corrected, models
from envs.biteno import Biteno, TaskConfig, constants
from envs.corrected import CorrectedBiteno, Correction
from jaxtune.mjx import TrainingBatch, select

ENTRIES = select(constants.ENTRIES, ("torque_scale",))
STEPS = 20


def robot(**effects):
    return CorrectedBiteno(TaskConfig(), ENTRIES, Correction(constants.MODEL_PATH, effects))


class Walker:
    """A robot whose episodes are compiled once: states [steps] under actions that wander."""

    def __init__(self, biteno):
        actions = jax.random.uniform(jax.random.key(1), (STEPS, 6), minval=-1.0)

        def play(torque_scale):
            params = {"torque_scale": torque_scale}
            start = biteno.reset(params, jax.random.key(0))

            def step(state, action):
                state = biteno.step(params, state, action)
                return state, state

            return start, jax.lax.scan(step, start, actions)[1]

        self._play = jax.jit(play)

    def __call__(self, torque_scale=1.0):
        return self._play(jnp.float32(torque_scale))


@pytest.fixture(scope="module")
def nominal():
    return Walker(Biteno(TaskConfig(), ENTRIES))


@pytest.fixture(scope="module")
def plain(nominal):
    return nominal()


everywhere = partial(dict.fromkeys, constants.JOINTS)


@pytest.mark.slow
def test_without_effects_it_is_the_robot_that_it_was(plain):
    start, states = Walker(robot())()
    np.testing.assert_allclose(start.obs, plain[0].obs, atol=1e-6)
    np.testing.assert_allclose(states.qpos, plain[1].qpos, atol=2e-4)
    np.testing.assert_allclose(states.score, plain[1].score, atol=2e-3)


def test_a_weak_motor_is_weak_whoever_says_so(nominal):
    weak = Walker(robot(torque_scale=everywhere({"ratio": 0.6})))
    np.testing.assert_allclose(weak()[1].qpos, nominal(0.6)[1].qpos, atol=2e-4)
    # And once more by what is tuned: 0.6 of 0.6.
    np.testing.assert_allclose(weak(0.6)[1].qpos, nominal(0.36)[1].qpos, atol=2e-4)


def test_a_command_that_is_a_policy_step_late_is_the_one_before():
    # The nominal robot knows such a delay as a parameter of the task.
    params = {"action_delay_s": jnp.float32(constants.POLICY_DT_S)}
    entries = select(constants.ENTRIES, ("action_delay_s",))
    late = CorrectedBiteno(
        TaskConfig(),
        ENTRIES,
        Correction(constants.MODEL_PATH, {"command_delay": everywhere({"seconds": constants.POLICY_DT_S})}),
    )
    known = Biteno(TaskConfig(), entries)
    actions = jax.random.uniform(jax.random.key(1), (5, 6), minval=-1.0)

    def play(biteno, params):
        start = biteno.reset(params, jax.random.key(0))
        # Both have been asked to stay where they are.
        start = start.replace(joint_error=jnp.zeros(6))
        return jax.lax.scan(lambda state, action: (biteno.step(params, state, action),) * 2, start, actions)[1]

    one = jax.jit(lambda: play(late, {"torque_scale": jnp.float32(1.0)}))()
    two = jax.jit(lambda: play(known, params))()
    np.testing.assert_allclose(one.qpos, two.qpos, atol=5e-4)


def test_a_biased_encoder_is_seen_by_the_policy_and_by_the_controller(plain):
    start, states = Walker(robot(encoder_bias={"left_knee": {"rad": 0.05}}))()
    knee = constants.JOINTS.index("left_knee")
    read = np.asarray(states.obs[:, 12 + knee]) + constants.STAND_RAD[knee]
    np.testing.assert_allclose(read, states.qpos[:, 7 + knee] + 0.05, atol=1e-5)
    np.testing.assert_allclose(start.obs[12 + knee] - plain[0].obs[12 + knee], 0.05, atol=1e-5)
    # The controller takes the knee to where it reads the target.
    assert (states.qpos[5:10, 7 + knee] < plain[1].qpos[5:10, 7 + knee]).all()


@pytest.mark.slow
def test_it_trains_behind_braxs_interface():
    effects = {"torque_lag": everywhere({"seconds": 0.01}), "backlash": {"left_hip": {"rad": 0.02}}}
    env = TrainingBatch(robot(**effects, load_friction=everywhere({"ratio": 0.1})), ENTRIES, 2000)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    state = jax.jit(env.step)(state, jnp.zeros((3, 6)))
    assert np.isfinite(state.obs).all()
    assert not state.done.any()


def test_what_discovery_wrote_is_read(tmp_path):
    from envs.rig import Rig

    rig = Rig(models.spec("biteno"), constants.JOINTS, 1000.0)
    effects = {"command_delay": {"right_hip": {"seconds": 0.004}}, "coulomb": {"left_knee": {"torque_nm": 0.7}}}
    corrected.save(tmp_path, models.spec("biteno"), rig, corrected.coordinates(rig, effects))
    read = corrected.read(tmp_path)
    assert set(read.effects) == {"command_delay"}
    biteno = CorrectedBiteno(TaskConfig(), ENTRIES, read)
    knee = biteno.joint_dof[constants.JOINTS.index("left_knee")]
    np.testing.assert_allclose(biteno.mj_model.dof_frictionloss[knee], 0.7, rtol=1e-6)


def test_an_unknown_effect_or_place_is_refused_by_name(tmp_path):
    (tmp_path / "model.xml").write_text("<mujoco/>")
    (tmp_path / "effects.json").write_text(json.dumps({"effects": {"gremlins": {}}}))
    with pytest.raises(ValueError, match="gremlins"):
        corrected.read(tmp_path)
    with pytest.raises(ValueError, match="third_knee"):
        robot(encoder_bias={"third_knee": {"rad": 0.1}})
    with pytest.raises(ValueError, match="degrees"):
        robot(encoder_bias={"left_knee": {"degrees": 3.0}})
    with pytest.raises(ValueError, match="is missing"):
        corrected.read(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        '{"effects": [1]}',
        '{"effects": {"backlash": 0.1}}',
        '{"effects": {"backlash": {"left_knee": {"rad": "wide"}}}}',
        '{"effects": {"backlash": {"left_knee": {"rad": "0.1"}}}}',
        '{"effects": {"backlash": {"left_knee": {"rad": NaN}}}}',
    ],
)
def test_damaged_effects_are_refused_by_the_name_of_their_file(tmp_path, content):
    (tmp_path / "model.xml").write_text("<mujoco/>")
    (tmp_path / "effects.json").write_text(content)
    with pytest.raises(ValueError, match=r"effects\.json: is damaged"):
        corrected.read(tmp_path)


@pytest.mark.parametrize(("old", "new"), [('"left_knee"', '"third_knee"'), ('"home"', '"start"')])
def test_a_model_of_another_robot_is_refused(tmp_path, old, new):
    text = constants.MODEL_PATH.read_text()
    assert old in text
    path = tmp_path / "model.xml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=r"model: .*model\.xml lacks joints of BITeno's or its keyframe home"):
        CorrectedBiteno(TaskConfig(), ENTRIES, Correction(path, {}))
