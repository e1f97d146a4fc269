"""Policies: saved, loaded, and the same next step; what belongs to another config is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import train as train_command
from experiments.common import checkpoint, files
from experiments.common.config import PRESETS, WALK
from experiments.walking.learner import Learner
from experiments.walking.policies import policy_config, starting_policy, trained, walk
from experiments.walking.robots import BITENO
from jaxtune.mjx import parameters


@pytest.fixture(scope="module")
def learner():
    return Learner(PRESETS["smoke"], BITENO.chosen("foot_friction"), BITENO.chosen("torque_scale"))


@pytest.fixture(scope="module")
def train(learner):
    dist = learner.dist(parameters.nominal(learner.entries), 0.3)
    return jax.jit(lambda key, policy: learner.train(key, policy, dist, 1))


def test_saved_policy_takes_the_same_next_step(learner, train, tmp_path):
    policy = learner.init(jax.random.PRNGKey(0))
    checkpoint.save(tmp_path, policy.learner, policy_config(learner))
    other = learner.init(jax.random.PRNGKey(7))
    loaded = other.replace(
        learner=checkpoint.load(tmp_path, other.learner, policy_config(learner)), robots=policy.robots
    )
    expected, _ = train(jax.random.PRNGKey(1), policy)
    found, metrics = train(jax.random.PRNGKey(1), loaded)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert np.isfinite(metrics["loss"]).all()
    # What was loaded, and what a step returns, is as good an input as what was made: nothing is compiled twice.
    train(jax.random.PRNGKey(2), found)
    assert train._cache_size() == 1


def test_robots_train_within_the_policy_radius_and_with_hidden_parameters(learner, train):
    policy = learner.init(jax.random.PRNGKey(0))
    other = policy.replace(radius=jnp.float32(0.2), hidden={"torque_scale": jnp.float32(0.75)})
    drawn, wider = (train(jax.random.PRNGKey(1), one)[0].robots.info["params"] for one in (policy, other))
    np.testing.assert_array_equal(drawn["torque_scale"], 1.0)
    np.testing.assert_array_equal(wider["torque_scale"], 0.75)
    # The distribution's radius is 0.3.
    for params, radius in ((drawn, learner.preset.policy_radius), (wider, 0.2)):
        spread = np.abs(np.log(params["foot_friction"]))
        assert 0.5 * radius < spread.max() <= radius + 1e-6
    assert train._cache_size() == 1


def leave_out(monkeypatch, shares):
    """Lets chunks of a training leave out these shares of their gradient steps, without the training."""
    left = iter(shares)
    chunk = lambda key, policy: (policy, {"reward": 1.0, "skipped": next(left)})  # noqa: E731
    monkeypatch.setattr("experiments.walking.policies.devices.on_all", lambda train: chunk)


def test_a_training_that_takes_no_step_is_no_success(learner, monkeypatch):
    leave_out(monkeypatch, [0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match=r"no gradient step was taken .* not finite"):
        walk(jax.random.PRNGKey(0), learner, 3 * learner.preset.chunk)


def test_a_training_says_how_many_steps_it_did_not_take(learner, monkeypatch, tmp_path, capsys):
    leave_out(monkeypatch, [0.0, 0.5])
    trained(jax.random.PRNGKey(0), learner, 2 * learner.preset.chunk, tmp_path / "policy")
    assert "25.00% of the gradient steps were not taken" in capsys.readouterr().out


def test_policy_of_another_config_is_refused(learner, tmp_path):
    ppo = learner.init(jax.random.PRNGKey(0)).learner
    checkpoint.save(tmp_path, ppo, policy_config(learner))
    task = dataclasses.replace(learner.preset.task, action_scale=0.5)
    other = Learner(dataclasses.replace(learner.preset, task=task), learner.entries)
    with pytest.raises(ValueError, match=r"config\.action_scale is 0\.25 there, expected 0\.5"):
        checkpoint.load(tmp_path, ppo, policy_config(other))


def test_a_policy_that_is_not_finite_is_not_played(learner, tmp_path):
    policy = learner.init(jax.random.PRNGKey(0)).learner
    broken = jax.tree.map(lambda leaf: leaf.at[..., 0].set(jnp.nan) if leaf.ndim == 2 else leaf, policy)
    checkpoint.save(tmp_path, broken, policy_config(learner))
    with pytest.raises(ValueError, match=rf"policy: {tmp_path}: got a number that is not finite in "):
        starting_policy(str(tmp_path), learner)


def test_missing_policy_is_named(learner, tmp_path):
    with pytest.raises(ValueError, match=r"policy: .*no config\.json"):
        checkpoint.load(tmp_path, None, policy_config(learner))


def test_shipped_policy_loads_and_has_learnt(learner):
    fresh = learner.init(jax.random.PRNGKey(0)).learner
    shipped = checkpoint.load(WALK, fresh, policy_config(learner))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(shipped.params))
    # A learner that has seen the task knows that joints do not all move alike.
    assert np.ptp(shipped.normalizer.std) > 0.1


def test_a_policy_from_scratch_needs_a_folder():
    with pytest.raises(ValueError, match="policy: got 'scratch', expected a policy that exists"):
        starting_policy("scratch", Learner(PRESETS["smoke"], {}))


def test_a_training_overwrites_no_other_policy_and_no_other_run(tmp_path, monkeypatch):
    monkeypatch.setattr(train_command, "Learner", lambda *_, **__: pytest.fail("it was begun"))
    args = train_command.Args(out=tmp_path, preset="smoke")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"out: .* holds a run of another command, expected a new folder"):
        train_command.main(args)
    files.write_json(tmp_path / "curve.json", {"args": args, "curve": []})
    for field, other in (("seed", 1), ("robot", "go2"), ("updates", 7)):
        with pytest.raises(ValueError, match=f"{field}: got {other}, but .* holds a policy with"):
            train_command.main(dataclasses.replace(args, **{field: other}))
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        monkeypatch.setattr(train_command.hosts, "join", lambda args: None)
        train_command.main(dataclasses.replace(args, hosts=2, host=1, coordinator="first:1"))
    # The same again, and one that was killed: between its two last lines, or earlier.
    for written in ({"args": args}, {"curve": []}):
        files.write_json(tmp_path / "curve.json", written)
        with pytest.raises(pytest.fail.Exception, match="it was begun"):
            train_command.main(args)
    (tmp_path / "training").mkdir()
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        train_command.main(dataclasses.replace(args, seed=1))
