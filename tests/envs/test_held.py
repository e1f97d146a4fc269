"""Joints that a log leaves out: which of them are held, and what a rig makes of them."""

import mujoco
import numpy as np
import pytest

from envs.held import held_joints, independent_joints
from envs.models import suspended
from envs.rig import Rig

ARM = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      {base}
      <inertial mass="5" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
      <body name="arm">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <inertial mass="1" pos="0 0 -0.1" diaginertia="0.01 0.01 0.01"/>
        <body name="left" pos="0.02 0 -0.2">
          <joint name="left" type="slide" axis="1 0 0"/>
          <inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
          <site name="grip"/>
        </body>
        <body name="right" pos="-0.02 0 -0.2">
          <joint name="right" type="slide" axis="-1 0 0"/>
          <inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>{tendon}</tendon>
  <equality>{equality}</equality>
  <actuator>{actuator}</actuator>
  <keyframe><key qpos="{key}"/></keyframe>
</mujoco>"""
SPLIT = '<fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed>'
MIMIC = '<joint joint1="left" joint2="right"/>'
PULLED = '<position tendon="split" kp="9"/>'
BASE = (
    '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>'
    '<joint name="pitch" axis="0 1 0"/>'
)


def robot(base="", tendon=SPLIT, equality=MIMIC, actuator=PULLED):
    joints = 3 + base.count("<joint")
    text = ARM.format(base=base, tendon=tendon, equality=equality, actuator=actuator, key=" ".join(["0"] * joints))
    return mujoco.MjSpec.from_string(text)


@pytest.mark.parametrize(
    ("options", "held"),
    [
        ({}, ("left", "right")),  # a tendon drives both
        ({"actuator": '<motor joint="left"/>'}, ("left", "right")),  # the other follows it
        ({"actuator": '<motor joint="left"/>', "equality": ""}, ("left",)),
        ({"actuator": ""}, ()),  # nobody holds them
        ({"equality": '<joint joint1="left" joint2="elbow"/>'}, ("right",)),  # follows what is read
        ({"equality": '<connect body1="left" body2="base" anchor="0 0 0"/>'}, ("right",)),  # a loop through it
        ({"equality": '<connect body1="left" body2="right" anchor="0 0 0"/>'}, ("left", "right")),
        ({"base": BASE}, ("x", "z", "pitch", "left", "right")),
        ({"base": '<joint name="yaw" axis="0 0 1"/>'}, ("left", "right")),  # a joint like any other
    ],
)
def test_joints_that_motors_hold_are_held_and_passive_ones_are_not(options, held):
    spec = robot(**options)
    assert held_joints(spec, ["elbow"]) == held
    model = suspended(spec, ["elbow"])
    names = {joint.name for joint in spec.joints} - set(held)
    assert {model.joint(number).name for number in range(model.njnt)} == names
    if "elbow" not in options.get("equality", "") and "base" not in options.get("equality", ""):
        # What tied held joints to each other is gone, and with it the work of solving for it.
        assert model.neq == 0 or "right" in names


def test_a_spring_between_fingers_ties_them():
    spring = SPLIT.replace('name="split"', 'name="split" stiffness="5"')
    spec = robot(equality="", tendon=spring, actuator='<motor joint="left"/>')
    assert held_joints(spec, ["elbow"]) == ("left", "right")


def test_a_log_of_all_joints_holds_none():
    spec = robot()
    assert held_joints(spec, ["elbow", "left", "right"]) == ()
    assert suspended(spec, ["elbow", "left", "right"]).njnt == suspended(spec).njnt == 3


def test_fingers_are_not_independent():
    assert independent_joints(robot()) == ("elbow",)
    assert independent_joints(robot(equality="")) == ("elbow", "left", "right")


def test_held_joints_move_with_the_link_that_carries_them():
    """The same as a model in which fingers have no joints."""
    held = Rig(robot(), ["elbow"], 500.0)
    assert held.others == ()
    without = robot(tendon="", equality="", actuator="")
    for name in ("left", "right"):
        without.delete(without.joint(name))
    without.delete(without.keys[0])
    pose = np.array([0.4])
    for one, other in zip(held.inertias(pose), Rig(without, ["elbow"], 500.0).inertias(pose), strict=True):
        np.testing.assert_allclose(one, other)
