"""The Go2: its figures, and that it stands; the commands are tried on it in `tests/experiments/test_robots.py`."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import go2
from jaxtune.mjx import from_coords, nominal


def test_its_figures_are_the_published_ones():
    model = mujoco.MjModel.from_xml_path(str(go2.MODEL_PATH))
    # Unitree: 15 kg with battery, thigh and calf of 0.213 m, torque of 23.7 Nm and 45.43 Nm at the knee.
    np.testing.assert_allclose(model.body_mass.sum(), 15.2, atol=0.05)
    assert [model.joint(joint).name for joint in range(1, model.njnt)] == list(go2.JOINTS)
    np.testing.assert_allclose(model.body("FL_calf").pos, [0, 0, -0.213])
    np.testing.assert_allclose(model.actuator_forcerange[:3, 1], [23.7, 23.7, 45.43])
    # Left and right are mirrored: the centre of mass is in the middle.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.subtree_com[1, 1], 0.0, atol=1e-3)


@pytest.fixture(scope="module")
def play():
    sim = replace(go2.simulator(), steps=250)
    params = nominal(sim.parameters)

    def play(act, **changes):
        values = {name: jnp.broadcast_to(jnp.asarray(value), 3) for name, value in (params | changes).items()}
        return sim.rollout(jax.random.key(0), lambda policy, obs, key: act(obs), None, values)

    return sim, jax.jit(play, static_argnums=0)


@pytest.mark.slow
def test_it_stands_and_falls(play):
    _, run = play
    still = run(lambda obs: jnp.zeros(12))
    assert not still.fell.any()
    assert still.alive.all()
    # Gravity in the body frame, of a robot that stands level.
    np.testing.assert_allclose(still.obs[:, -1, 3:6], [[0, 0, -1]] * 3, atol=0.1)
    # Legs that are pulled up let it fall, and the rest of the episode does not count.
    folded = run(lambda obs: jnp.tile(jnp.array([0.0, 8.0, -4.0]), 4))
    assert folded.fell.all()
    assert not folded.alive[:, -1].any()
    assert (folded.score[~folded.alive] == 0).all()


def test_its_parameters_are_felt(play):
    sim, run = play
    still = lambda obs: jnp.zeros(12)  # noqa: E731
    # A heavier base bends the rear knees further.
    knee = run(still, base_mass=jnp.array([0.6, 1.0, 1.8])).obs[:, -1, 17]
    assert knee[0] > knee[1] > knee[2]
    centre = from_coords(sim.parameters, sim.dist(0.2).centre)
    assert {name: float(value) for name, value in centre.items()} == pytest.approx(nominal(sim.parameters))
