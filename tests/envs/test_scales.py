"""Sizes of coordinates, from what a robot did in a log."""

import mujoco
import numpy as np
import pytest

from envs.logs import Controller, Log, Run
from envs.null_logs import simulate_null_logs
from envs.regimes import control_torque
from envs.rig import Rig
from envs.scales import measure_scales
from envs.smoothing import smoothed
from tests.rigs import ARM, ARM_JOINTS


@pytest.mark.parametrize("kp", [[40.0, 20.0], [40.0, 0.0]], ids=["driven", "passive"])
def test_a_torque_of_one_is_what_moves_the_joint(kp):
    """The elbow swings under what the shoulder does."""
    time = np.arange(1000) / 200.0
    target = np.sin(2 * np.pi * time)[:, None] * [0.8, 0.0]
    gains = {"kp": np.array(kp), "kd": np.array([2.0, 0.4 if kp[1] else 0.0]), "torque_limit_nm": np.full(2, np.inf)}
    run = Run(
        name="run_000",
        condition="a",
        split=None,
        controller=Controller(kind="pd", rate_hz=500.0, gains=gains, between_rows="hold"),
        time=time,
        signals={"q": np.zeros_like(target), "target": target},
        known={"q": {"noise_sd": np.full(2, 1e-5)}},
    )
    log = Log(robot="", base="fixed", rate_hz=200.0, joints=ARM_JOINTS, policy=None, runs=(run,))
    spec = mujoco.MjSpec.from_string(ARM)
    (played,) = simulate_null_logs(log, spec, 1, 0)
    found = measure_scales(Rig(spec, ARM_JOINTS, 500.0), played.runs)
    commanded, _ = control_torque(played.runs[0], *np.moveaxis(smoothed(played.runs[0]), 1, 0))
    rms = np.sqrt((commanded**2).mean(axis=0))
    assert found["torque"][0] == pytest.approx(rms[0], rel=1e-4)
    if kp[1]:
        assert found["torque"][1] == pytest.approx(rms[1], rel=1e-4)
    else:
        assert not rms[1]
        # The weight of 0.6 kg, 0.125 m from the elbow, would be 0.74 Nm if it hung level.
        assert 0.05 < found["torque"][1] < 2.0
    np.testing.assert_allclose(found["damping"] * found["speed"], found["torque"], rtol=1e-5)
    # A spring that takes all of the torque at the rms angle.
    angle = np.sqrt((played.runs[0].signals["q"] ** 2).mean(axis=0))
    np.testing.assert_allclose(found["spring"] * angle, found["torque"], rtol=1e-3)
    np.testing.assert_allclose(found["of_before"][1] * found["torque"][0], found["torque"][1], rtol=1e-5)
    np.testing.assert_allclose(found["of_after"][0] * found["torque"][1], found["torque"][0], rtol=1e-5)
    # The shoulder alone moves the upper arm, whose centre is 0.15 m away: drag there is damping of the shoulder.
    assert found["drag"][0] * 0.15**2 == pytest.approx(found["damping"][0], rel=1e-4)


def test_joints_that_do_not_move_a_link_say_nothing_of_its_drag():
    # A wrist that turns about the hand's long axis, at rest and without torque.
    hand = '<body name="hand" pos="0 0 -0.25"><joint name="roll" axis="0 0 1"/>'
    hand += '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.1" mass="0.02"/></body>'
    whole = ARM.replace('mass="0.6"/>', f'mass="0.6"/>{hand}')
    time = np.arange(400) / 200.0
    moved = 0.2 * np.sin(2 * np.pi * time)[:, None]
    gains = {"kp": np.full(3, 40.0), "kd": np.full(3, 2.0), "torque_limit_nm": np.full(3, 15.0)}
    signals = {"q": moved * [1.0, 0.5, 0.0], "target": 1.2 * moved * [1.0, 0.5, 0.0]}
    run = Run(
        name="run_000",
        condition="a",
        split=None,
        controller=Controller(kind="pd", rate_hz=500.0, gains=gains),
        time=time,
        signals=signals,
    )
    found = measure_scales(Rig(mujoco.MjSpec.from_string(whole), (*ARM_JOINTS, "roll"), 500.0), [run])
    assert found["drag"][0] * 0.15**2 == pytest.approx(found["damping"][0], rel=1e-4)
    # The elbow is the weaker one: 0.3 m from the hand's centre, which both joints move.
    speed = np.hypot(0.6 * found["speed"][0], 0.3 * found["speed"][1])
    assert found["drag"][2] == pytest.approx(found["torque"][1] / 0.3 / speed, rel=1e-4)
    assert found["air"][2] == pytest.approx(found["drag"][2] / speed, rel=1e-4)
    # A light hand may carry as much as a twentieth of the arm.
    np.testing.assert_allclose(found["mass"], [1.2, 0.6, 0.05 * 1.82], rtol=1e-6)


def test_a_slide_has_no_angles():
    xml = ARM.replace('name="elbow"', 'name="elbow" type="slide"')
    time = np.arange(400) / 200.0
    moved = 0.1 * np.sin(2 * np.pi * time)[:, None] * [1.0, 0.5]
    run = Run(
        name="run_000",
        condition="a",
        split=None,
        controller=Controller(
            kind="pd",
            rate_hz=500.0,
            gains={"kp": np.full(2, 40.0), "kd": np.full(2, 2.0), "torque_limit_nm": np.full(2, 15.0)},
        ),
        time=time,
        signals={"q": moved, "target": 1.2 * moved},
    )
    rig = Rig(mujoco.MjSpec.from_string(xml), ARM_JOINTS, 500.0)
    found = measure_scales(rig, [run])
    np.testing.assert_allclose(found["angle"], [1.0, 0.05])
    np.testing.assert_allclose(found["stiffness"], found["torque"] / [0.02, 0.001], rtol=1e-6)
    np.testing.assert_allclose(found["hardening"], [2.5e3, 1e6], rtol=1e-6)
    for name in ("deadband", "backlash", "encoder_bias"):
        angles = [axis for axis in rig.scaled(found).axes if (axis.effect, axis.parameter) == (name, "rad")]
        axes = {axis.place: axis.scale for axis in angles}
        assert axes == pytest.approx({"shoulder": 1.0, "elbow": 0.05})
