import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reference

from envs import sensing, stepping
from envs.biteno import Biteno, Motion, TaskConfig, constants, onboard
from jaxtune.mjx import TrainingBatch
from jaxtune.mjx.episodes import rollout

NOMINAL = reference.params()
STILL = np.zeros(6, np.float32)
# Over ten sub-steps single precision reaches 3e-7 m or rad and 3e-5 m/s or rad/s, where joints turn at up to 20 rad/s
# (double precision 1e-15 and 1e-13).
POSITION_ATOL = 1e-6
VELOCITY_ATOL = 1e-4
JOINT, ERROR = slice(12, 18), slice(30, 36)  # of an observation
# One robot of each kind, which a batch of Brax steps at once.
WELL, FALLEN, BROKEN, LATE = range(4)


def tilted(state, angle_rad, height_m=0.9):
    """At rest in the air in the standing pose, leaning forward."""
    qpos = state.qpos.at[2].set(height_m).at[7:].set(constants.STAND_RAD)
    qpos = qpos.at[3:7].set(jnp.array([np.cos(angle_rad / 2), 0.0, np.sin(angle_rad / 2), 0.0]))
    return state.replace(qpos=qpos, qvel=jnp.zeros(12))


def broken(state):
    return state.replace(qvel=state.qvel.at[8].set(jnp.nan))


def assert_states(got, expected, atol=1e-5):
    """Equal but for rounding; speeds and what follows from them are some ten times as large."""
    leaves = zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(expected), strict=True)
    for (path, leaf), other in leaves:
        np.testing.assert_allclose(leaf, other, rtol=1e-4, atol=10 * atol, err_msg=jax.tree_util.keystr(path))
    np.testing.assert_allclose(got.qpos, expected.qpos, atol=atol)


# Another engine


def scenes():
    """Robots on the floor and in the air, nominal and not: parameters, positions, velocities, actions."""
    rng = np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_path(str(constants.MODEL_PATH))
    for number in range(24):
        # The lower foot 3 mm in the floor, just above it so that it lands on the way, or far from it.
        clearance = (-0.003, 0.001, 0.2)[number % 3]
        values = NOMINAL if number < 12 else reference.draw(rng, constants.ENTRIES, share=0.5)
        qpos, qvel = reference.random_state(rng, model, clearance)
        qvel[2] = -abs(qvel[2])
        yield values, qpos, qvel, rng.normal(size=6).astype(np.float32)
    # Two that slide on ice, and one in the air whose joints are beyond their limits.
    for speed in (2.0, -2.0):
        qpos, qvel = reference.random_state(rng, model, -0.002)
        qvel[0] = speed
        yield reference.params(foot_friction=0.2), qpos, qvel, STILL
    qpos, qvel = reference.random_state(rng, model, 0.1)
    qpos[7:] = [0.85, -1.43, 2.25, -0.85, 1.05, 0.05]
    yield NOMINAL, qpos, qvel, STILL


@pytest.fixture(scope="module")
def engines(robot, start, step):
    """For every scene and each of two steps: MJX's state after it, MuJoCo C's model and data, and most contacts."""
    played = []
    for values, qpos, qvel, action in scenes():
        state = start.replace(qpos=qpos, qvel=qvel)
        model = reference.recompiled(values)
        # The whole table has friction in the joints, which takes twice the iterations.
        model.opt.timestep, model.opt.iterations, model.opt.ls_iterations = 0.001, 6, 10
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        # A new robot's joints are held where they are, as far as a target may be there.
        held = np.clip(data.qpos[7:], *onboard.joint_ranges())
        # The second step starts where the first one left the solver.
        for moved in (action, -action):
            state = step(values, state, moved)
            target = np.clip(constants.STAND_RAD + 0.25 * moved.astype(float), *onboard.joint_ranges())
            contacts = 0
            for substep in range(10):
                late = np.clip(values["action_delay_s"] / 0.001 - substep, 0.0, 1.0)
                data.ctrl[:] = late * held + (1.0 - late) * target
                mujoco.mj_step(model, data)
                contacts = max(contacts, data.ncon)
            held = target
            played.append((state, model, copy.copy(data), contacts))
    return played


def test_a_step_of_mjx_is_ten_of_mujoco(engines):
    for number, (state, _, data, _) in enumerate(engines):
        scene = f"scene {number // 2}"
        np.testing.assert_allclose(state.qpos, data.qpos, atol=POSITION_ATOL, rtol=0, err_msg=scene)
        np.testing.assert_allclose(state.qvel, data.qvel, atol=VELOCITY_ATOL, rtol=0, err_msg=scene)
        # The torque of the last sub-step, to which 3e-5 rad/s are 6e-5 Nm in some 10.
        expected = np.sum(data.qfrc_actuator[6:] ** 2)
        np.testing.assert_allclose(state.terms["torque"], expected, rtol=2e-5, err_msg=scene)


def test_products_of_the_physics_are_not_shortened(robot):
    """A GPU would round what goes into them to ten bits, unless it is told otherwise."""
    params = {name: jnp.ones(1) for name in NOMINAL}
    play = jax.jit(lambda key: rollout(robot, key, lambda obs, key: obs[:6], params, 1))
    products = [line for line in play.lower(jax.random.key(0)).as_text().splitlines() if "dot_general" in line]
    assert products
    assert all("HIGHEST, HIGHEST" in line for line in products)


def test_those_scenes_touch_the_floor_land_and_fly(engines):
    contacts = [contacts for *_, contacts in engines[::2]]
    assert all(contacts[0:24:3])
    assert sum(contacts[1:24:3]) >= 4
    assert not any(contacts[2:24:3])
    assert all(contacts[24:26])


def test_an_action_that_is_a_step_late_is_the_one_before(start, step):
    late = reference.params(action_delay_s=constants.POLICY_DT_S)
    first, second = (np.full(6, value, np.float32) for value in (0.5, -0.7))
    once = step(late, start, first)
    twice = step(late, once, second)
    # The first action arrives in the second step, whatever is asked there; what was held before is the pose itself.
    np.testing.assert_allclose(twice.qpos, step(NOMINAL, once, first).qpos, atol=1e-6)
    held = (start.qpos[7:] - constants.STAND_RAD) / 0.25
    np.testing.assert_allclose(once.qpos, step(NOMINAL, start, held).qpos, atol=1e-6)
    assert np.abs(twice.qpos - step(NOMINAL, once, second).qpos).max() > 1e-3


def test_what_acts_on_the_joints_stays_within_their_ranges(start):
    robot = Biteno(TaskConfig(base="stand"), {})
    low, high = onboard.joint_ranges()
    for action, ends in ((10.0, high), (-10.0, low)):
        drive = robot.drive({}, start, jnp.full(6, action))
        beyond = (constants.STAND_RAD + 0.25 * action < low) | (constants.STAND_RAD + 0.25 * action > high)
        assert beyond.all()
        np.testing.assert_allclose(drive.targets, np.tile(ends, (robot.substeps, 1)), rtol=1e-6)
        # The policy observes what it meant.
        np.testing.assert_allclose(drive.target, constants.STAND_RAD + 0.25 * action, rtol=1e-6)


def still(robot, start):
    """A drive and a motion that leave a robot where it is, on its left foot, and the drive's own robot."""
    drive = robot.drive({}, start, jnp.zeros(6))
    motion = Motion(
        qpos=start.qpos,
        qvel=start.qvel,
        qacc_warmstart=jnp.zeros(12),
        torque=jnp.zeros(6),
        foot_force=jnp.array([[0.0, 0.0, 150.0], [0.0, 0.0, 0.0]]),
    )
    return drive, motion


def test_a_push_comes_on_time_and_adds_its_speed(start):
    robot = Biteno(TaskConfig(push_mps=0.5, push_s=4.0), {})
    before = start.replace(steps=jnp.int32(398))
    quiet = robot.settle(before, *still(robot, before))
    np.testing.assert_array_equal(quiet.qvel, before.qvel)
    pushed = robot.settle(quiet, *still(robot, quiet))
    np.testing.assert_allclose(np.hypot(*(pushed.qvel - before.qvel)[:2]), 0.5, rtol=1e-5)
    np.testing.assert_array_equal(pushed.qvel[2:], before.qvel[2:])
    # It is felt at once.
    assert np.abs(pushed.obs[:2] - quiet.obs[:2]).max() > 0.1


def test_shaping_is_trained_and_logged_but_not_scored(start):
    shaped, plain = (Biteno(TaskConfig(shaping=weights), {}) for weights in ({"clock_contact": -2.0}, {}))
    phase = jnp.array([0.7, 0.2])  # on the wrong foot
    before = start.replace(phase=phase)
    one, other = (robot.settle(before, *still(robot, before)) for robot in (shaped, plain))
    np.testing.assert_allclose(one.terms["clock_contact"], 2.0)
    assert "clock_contact" not in other.terms
    # 2 feet x -2 x 0.01 s.
    np.testing.assert_allclose(one.reward - other.reward, -0.04, rtol=1e-4)
    assert one.score == other.score


def test_unknown_shaping_is_named():
    with pytest.raises(ValueError, match=r"shaping: got \['grace'\], expected some of \['clock_contact'\]"):
        Biteno(TaskConfig(shaping={"grace": 1.0}))


def test_what_is_observed_of_the_trunk_is_mujocos_velocity_of_it(engines):
    for state, model, data, _ in engines:
        mujoco.mj_forward(model, data)
        velocity = np.zeros(6)
        trunk = model.body("trunk").id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, trunk, velocity, True)
        np.testing.assert_allclose(state.obs[6:9] / 0.25, velocity[:3], atol=VELOCITY_ATOL)
        np.testing.assert_allclose(state.obs[0:3] / 2.0, velocity[3:], atol=VELOCITY_ATOL)
        np.testing.assert_allclose(state.obs[9:12], data.body("trunk").xmat.reshape(3, 3).T @ [0, 0, -1], atol=1e-5)
        np.testing.assert_allclose(state.obs[12:18], data.qpos[7:] - constants.STAND_RAD, atol=POSITION_ATOL)
        np.testing.assert_allclose(state.obs[18:24] / 0.05, data.qvel[6:], atol=VELOCITY_ATOL)


# Identities


def test_a_step_without_jit_is_the_same(start, monkeypatch):
    # Another physics stands in, since MJX would be compiled by its scan in either case.
    idle(
        monkeypatch,
        lambda model, data: data.replace(
            qpos=data.qpos.at[1:].add(1e-3 * data.qvel),
            qvel=data.qvel.at[6:].add(0.05 * data.ctrl),
            qfrc_actuator=data.qvel * 2.0,
        ),
    )
    robot = Biteno(TaskConfig())
    monkeypatch.setattr(robot, "model", lambda params: robot._model)
    action = jnp.linspace(-1.0, 1.0, 6)
    assert_states(robot.step(NOMINAL, start, action), jax.jit(robot.step)(NOMINAL, start, action))


@pytest.mark.slow
def test_a_step_without_jit_is_the_same_down_to_the_physics(robot, start, step):
    values, action = reference.params(foot_friction=0.5, left_shank_mass=1.5), jnp.linspace(-1.0, 1.0, 6)
    assert_states(robot.step(values, start, action), step(values, start, action))


@pytest.fixture(scope="module")
def brax(robot):
    """The robot behind Brax's interface, its step and how often that was traced."""
    env = TrainingBatch(robot, robot.entries, 2000)
    traces = []

    @jax.jit
    def step(state, action):
        traces.append(None)
        return env.step(state, action)

    return env, step, traces


def row_of(tree, row):
    return jax.tree.map(lambda leaf: leaf[row], tree)


@pytest.fixture(scope="module")
def batch(brax, reset_keys):
    """Four robots at once, each with parameters and an action of its own: before and after a step."""
    env, step, _ = brax
    rng = np.random.default_rng(4)
    draws = [reference.draw(rng, constants.ENTRIES, share=0.3) for _ in range(4)]
    values = {name: jnp.stack([draw[name] for draw in draws]) for name in NOMINAL}
    before = jax.jit(env.start)(values, reset_keys[:4])
    robots = [row_of(before.pipeline_state, row) for row in range(4)]
    last = jnp.int32(1999)  # 20 s are 2000 steps
    robots[FALLEN] = tilted(robots[FALLEN], np.deg2rad(60)).replace(steps=last)
    robots[BROKEN] = broken(robots[BROKEN])
    robots[LATE] = robots[LATE].replace(steps=last)
    before = before.replace(pipeline_state=jax.tree.map(lambda *leaves: jnp.stack(leaves), *robots))
    action = jnp.asarray(rng.normal(size=(4, 6)), jnp.float32)
    return before, action, step(before, action)


def test_a_step_of_a_batch_is_that_of_a_loop(batch, step):
    before, action, after = batch
    for row in range(4):
        state, values = row_of((before.pipeline_state, before.info["params"]), row)
        alone = step(values, state, action[row])
        np.testing.assert_allclose(after.reward[row], alone.reward, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(after.metrics["score"][row], alone.score, rtol=1e-4, atol=1e-5)
        assert after.metrics["not_finite"][row] == alone.not_finite
        for name, value in alone.terms.items():
            np.testing.assert_allclose(after.metrics[name][row], value, rtol=1e-3, atol=1e-4, err_msg=name)
        if row == WELL:
            assert_states(row_of(after.pipeline_state, WELL), alone)


def test_other_parameters_are_not_compiled_anew(brax, batch):
    env, step, traces = brax
    before, action, after = batch
    assert len(traces) == 1
    other = env.with_params(before, {**before.info["params"], "torque_scale": jnp.full(4, 0.5, jnp.float32)})
    weak = step(other, action)
    assert len(traces) == 1
    # They do act: the same robot under the same action moves otherwise.
    assert np.abs(weak.pipeline_state.qvel[WELL] - after.pipeline_state.qvel[WELL]).max() > 0.01
    np.testing.assert_array_equal(weak.info["params"]["torque_scale"], 0.5)


# Ends of an episode


@pytest.mark.parametrize(("degrees", "done"), [(44.0, 0.0), (46.0, 1.0)])
def test_tilt_ends_an_episode(start, step, degrees, done):
    state = step(NOMINAL, tilted(start, np.deg2rad(degrees)), STILL)
    assert state.done == done
    assert state.not_finite == 0.0


@pytest.mark.parametrize(("height_m", "done"), [(0.353, 0.0), (0.349, 1.0)])
def test_a_low_hip_ends_an_episode(start, step, height_m, done):
    # Legs folded to 0.62 cos(1.1) = 0.28 m, held there, so that the feet stay off the floor; it falls by 0.5 mm.
    state = tilted(start, 0.0, height_m)
    state = state.replace(qpos=state.qpos.at[7:].set(jnp.array([0.0, -1.1, 2.2] * 2)))
    action = jnp.array([0.0, -3.0, 6.0] * 2)  # -0.35 - 0.75 = -1.1 and 0.70 + 1.5 = 2.2
    assert step(NOMINAL, state, action).done == done


def test_a_fall_costs_the_trained_reward_and_not_the_score(robot, start, step):
    state = step(NOMINAL, tilted(start, np.deg2rad(60)), STILL)
    earned = {
        name: 0.01 * sum(weight * float(state.terms[term]) for term, weight in weights.items())
        for name, weights in (("reward", constants.WALKING | constants.SHAPING), ("score", constants.TABLE_ONE))
    }
    # sin(60 degrees)^2 = 0.75 is the orientation's term, which the fall deserves in either.
    np.testing.assert_allclose(state.terms["orientation"], 0.75, atol=0.01)
    np.testing.assert_allclose(state.score, earned["score"], rtol=1e-5)
    np.testing.assert_allclose(state.reward, earned["reward"] - 1.0, rtol=1e-5)
    assert robot.config.termination_cost == 1.0


def assert_broke(state):
    assert state.done == 1.0
    assert state.not_finite == 1.0
    assert all(value == 0.0 for value in state.terms.values())
    assert state.reward == -1.0
    assert state.score == 0.0
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        assert np.all(np.isfinite(leaf)), jax.tree_util.keystr(path)


def test_a_broken_simulation_ends_the_episode_and_leaves_no_trace(start, step):
    assert_broke(step(NOMINAL, broken(start), STILL))


def test_broken_parameters_end_the_episode_and_leave_no_trace(start, step):
    assert_broke(step(reference.params(trunk_mass=np.nan), start, STILL))


def test_a_broken_action_ends_the_episode_and_leaves_no_trace(start, step):
    assert_broke(step(NOMINAL, start, np.full(6, np.nan, np.float32)))


def test_brax_hears_of_the_time_limit_as_truncation_and_not_as_a_fall(batch):
    _, _, after = batch
    np.testing.assert_array_equal(after.info["truncation"], [0, 0, 0, 1])
    np.testing.assert_array_equal(after.done, [0, 1, 1, 1])
    np.testing.assert_array_equal(after.metrics["not_finite"], [0, 0, 1, 0])
    # Time that ran out costs nothing; of a fall in the last step only the fall counts.
    assert after.reward[LATE] > -0.5
    assert after.reward[FALLEN] < -0.9


def test_those_that_ended_start_anew_and_keep_their_parameters(batch):
    before, _, after = batch
    state = after.pipeline_state
    np.testing.assert_array_equal(state.steps, [1, 0, 0, 0])
    np.testing.assert_array_equal(after.obs, state.obs)
    assert np.all(np.isfinite(after.obs))
    for row in (FALLEN, BROKEN, LATE):
        # As after a reset: near the standing pose, no action yet.
        np.testing.assert_allclose(state.qpos[row, :7], [0, 0, 0.612, 1, 0, 0, 0], atol=1e-6)
        np.testing.assert_allclose(state.qpos[row, 7:], constants.STAND_RAD, atol=0.1)
        assert np.abs(state.qvel[row]).max() <= 0.2
        np.testing.assert_array_equal(state.action[row], 0.0)
        np.testing.assert_array_equal(state.done[row], 0.0)
    # Each of them otherwise than the last time, and than the others.
    assert len({tuple(row) for row in np.asarray(jnp.concatenate([state.qpos, before.pipeline_state.qpos]))}) == 8
    assert after.info["params"].keys() == before.info["params"].keys()
    for name, value in before.info["params"].items():
        np.testing.assert_array_equal(after.info["params"][name], value)


def test_brax_starts_nominal_robots(brax, reset_keys, fresh):
    env, _, _ = brax
    state = jax.jit(env.reset)(reset_keys[:4])
    assert state.info["params"].keys() == NOMINAL.keys()
    for name, value in NOMINAL.items():
        np.testing.assert_array_equal(state.info["params"][name], np.full(4, value))
    np.testing.assert_allclose(state.obs, fresh.obs[:4], atol=1e-6)
    assert state.obs.shape == (4, env.observation_size)
    assert env.action_size == 6


# The task


def test_a_reset_is_near_the_standing_pose(fresh):
    np.testing.assert_allclose(fresh.qpos[:, :7], np.tile([0, 0, 0.612, 1, 0, 0, 0], (2000, 1)), atol=1e-6)
    # Of 2000 draws the largest is within a hundredth of the edge, in every joint.
    off = np.abs(fresh.qpos[:, 7:] - constants.STAND_RAD).max(axis=0)
    assert np.all((off > 0.099) & (off < 0.1001))
    fastest = np.abs(fresh.qvel).max(axis=0)
    assert np.all((fastest > 0.198) & (fastest <= 0.2))
    assert not np.any(fresh.steps)


def test_commands_fill_their_box_and_one_in_ten_is_zero(fresh):
    command = np.asarray(fresh.command)
    zero = np.all(command == 0.0, axis=1)
    # Standard deviation of the share is sqrt(0.1 0.9 / 2000) = 0.0067.
    np.testing.assert_allclose(zero.mean(), 0.1, atol=4 * 0.0067)
    assert not np.any(command[~zero] == 0.0)
    np.testing.assert_allclose(command.max(axis=0), [1.0, 0.3, 0.8], rtol=0.01)
    np.testing.assert_allclose(command.min(axis=0), [-1.0, -0.3, -0.8], rtol=0.01)
    # Standard deviation of the mean is 1 / sqrt(3 x 1800) = 0.0136 of the width.
    np.testing.assert_allclose(command[~zero].mean(axis=0) / [1.0, 0.3, 0.8], 0.0, atol=4 * 0.0136)


def test_commands_change_every_five_seconds(start, step):
    state = start
    for steps in (1, 250, 498, 500):
        following = step(NOMINAL, state.replace(steps=jnp.int32(steps)), STILL)
        np.testing.assert_array_equal(following.command, state.command)
    # The step that completes 5 s or 10 s of 10 ms each.
    for steps in (499, 999):
        following = step(NOMINAL, state.replace(steps=jnp.int32(steps)), STILL)
        assert np.any(following.command != state.command)
        np.testing.assert_array_equal(following.obs[3:6], following.command * np.array([2.0, 2.0, 0.25], np.float32))


def test_the_next_command_is_no_matter_of_parameters(start, step):
    state = start.replace(steps=jnp.int32(499))
    light = step(reference.params(trunk_mass=0.5), state, STILL)
    heavy = step(reference.params(trunk_mass=2.0), state, STILL + 1)
    np.testing.assert_array_equal(light.command, heavy.command)
    np.testing.assert_array_equal(jax.random.key_data(light.key), jax.random.key_data(heavy.key))


def test_actions_are_clipped_at_ten(start, step):
    state = start
    sign = np.array([1, -1, 1, -1, 1, -1], np.float32)
    limit = step(NOMINAL, state, 10 * sign)
    beyond = step(NOMINAL, state, 1e6 * sign)
    for got, expected in zip(jax.tree.leaves(beyond), jax.tree.leaves(limit), strict=True):
        np.testing.assert_array_equal(got, expected)
    # It is the clipped action that is remembered, and no smaller one is touched.
    np.testing.assert_array_equal(beyond.action, 10 * sign)
    np.testing.assert_array_equal(step(NOMINAL, state, 9.5 * sign).action, 9.5 * sign)


def test_a_step_remembers_its_action_and_the_error_it_left(start, step):
    state = start
    action = np.linspace(-1, 1, 6, dtype=np.float32)
    following = step(NOMINAL, state, action)
    np.testing.assert_array_equal(following.obs[24:30], action)
    # A quarter of a rad for each unit of action, around the standing pose.
    target = constants.STAND_RAD + 0.25 * action
    np.testing.assert_allclose(following.obs[30:36], target - following.qpos[7:], atol=1e-6)
    np.testing.assert_allclose(following.phase, np.mod(state.phase + 0.0175, 1.0), atol=1e-6)
    assert following.steps == 1


def idle(monkeypatch, move=lambda model, data: data):
    """Has another physics stand in, for the sake of a quick compilation."""
    monkeypatch.setattr(stepping, "step", move)


def test_the_error_of_a_joint_is_of_the_reading_that_is_observed(start):
    noisy, clean = (Biteno(TaskConfig(noise=noise)) for noise in (1.0, 0.0))
    later = start.replace(steps=jnp.asarray(3), joint_error=jnp.linspace(-0.1, 0.1, 6))
    off = noisy._observe(later, jax.random.key(1)) - clean._observe(later, jax.random.key(1))
    joint, error = (off[part] / sensing.LAYOUT[name] for name, part in (("joint", JOINT), ("joint_error", ERROR)))
    assert np.abs(joint).max() > 1e-3
    np.testing.assert_allclose(error, -joint, atol=1e-6)
    # Before the first target there is none.
    first = noisy._observe(start, jax.random.key(1))
    np.testing.assert_array_equal(first[ERROR], 0.0)


def test_raiberts_base_is_the_reference_of_phase_and_command(start, monkeypatch):
    idle(monkeypatch)
    robot = Biteno(TaskConfig(base="raibert"))
    state = start.replace(phase=jnp.array([0.25, 0.75]), command=jnp.zeros(3))
    action = np.array([0.4, 0, 0, 0, -0.4, 0], np.float32)
    following = jax.jit(robot.step)(NOMINAL, state, action)
    # As in test_gait: the left leg stands, the right one is folded at the top of its swing; 0.25 x 0.4 = 0.1 rad.
    target = [0.1, -0.352, 0.704, 0.0, -0.7275, 1.255]
    np.testing.assert_allclose(following.joint_error + following.qpos[7:], target, atol=1e-3)


def test_every_term_is_handed_what_it_is_of(start, monkeypatch):
    # Each sub-step, a physics that turns the left hip by 0.1 rad/s more and pushes every degree of freedom by 2 Nm.
    idle(
        monkeypatch,
        lambda model, data: data.replace(qvel=data.qvel.at[7].add(0.1), qfrc_actuator=jnp.full(12, 2.0)),
    )
    state = tilted(start, 0.0).replace(
        qvel=jnp.zeros(12).at[2].set(0.3).at[5].set(0.5),
        phase=jnp.array([0.25, 0.75]),
        command=jnp.array([0.5, 0.0, 0.0]),
        action=jnp.array([0.0, 0, 0, 0, 0, 2.0]),
        steps=jnp.int32(499),
    )
    state = jax.jit(Biteno(TaskConfig()).step)(NOMINAL, state, jnp.array([1.0, 0, 0, 0, 0, 0]))
    expected = {
        # The command of this step, not the one it draws: 0.5 m/s and rad/s missed, exp(-4 / 4).
        "linear_tracking": 0.367879,
        "angular_tracking": 0.367879,
        "linear_velocity_z": 0.09,
        "angular_velocity_xy": 0.0,
        # The joints' 6 x 4, not the trunk's.
        "torque": 24.0,
        "orientation": 0.0,
        # 1 rad/s in 0.01 s is 100 rad/s^2.
        "joint_acceleration": 1e4,
        # 1 and 2.
        "action_rate": 5.0,
        "joint_default": 0.0,
        # The phase of this step: the right leg at the top of its swing is off by 0.277194 and 0.554388 rad, the left
        # one by 0.001929 and 0.003857: 0.384183 + 0.000019.
        "raibert": 0.384202,
        # The left foot should stand, and nothing presses on it.
        "clock_contact": 1.0,
    }
    assert state.terms.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(state.terms[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(("physics", "substep_s"), [("exact", 0.001), ("fast", 0.002)])
def test_both_physics_make_a_policy_step_of_ten_milliseconds(start, monkeypatch, physics, substep_s):
    idle(monkeypatch, lambda model, data: data.replace(qpos=data.qpos.at[0].add(model.opt.timestep)))
    robot = Biteno(TaskConfig(physics=physics))
    following = jax.jit(robot.step)(NOMINAL, start, STILL)
    np.testing.assert_allclose(following.qpos[0], 0.01, rtol=1e-5)
    np.testing.assert_allclose(robot.mj_model.opt.timestep, substep_s)


def test_an_unknown_physics_is_named():
    with pytest.raises(ValueError, match="physics: got 'quick', expected one of exact, fast"):
        Biteno(TaskConfig(physics="quick"))


def test_a_missing_weight_is_named():
    weights = {name: weight for name, weight in constants.WALKING.items() if name != "torque"}
    with pytest.raises(ValueError, match=r"weights: got .*expected .*'torque'"):
        Biteno(TaskConfig(weights=weights))


def test_an_unknown_base_is_named():
    with pytest.raises(ValueError, match="base: got 'sitting', expected one of stand, raibert"):
        Biteno(TaskConfig(base="sitting"))


def test_no_two_configs_share_their_weights():
    first, second = TaskConfig(), TaskConfig()
    assert first.weights == constants.WALKING
    assert first.weights is not second.weights
    assert first.weights is not constants.WALKING
    assert first.shaping == constants.SHAPING
    assert first.shaping is not second.shaping
    assert first.shaping is not constants.SHAPING
