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


MOTOR = '<motor joint="left"/>'
TO_BASE = '<connect body1="left" body2="base" anchor="0 0 0"/>'


@pytest.mark.parametrize(
    ("options", "held", "left"),
    [
        ({}, ("left", "right"), 0),  # a tendon drives both
        ({"actuator": MOTOR}, ("left", "right"), 0),  # the other follows it
        ({"actuator": MOTOR, "equality": ""}, ("left",), 0),
        ({"actuator": MOTOR, "equality": MIMIC.replace("/>", ' active="false"/>')}, ("left",), 0),
        ({"actuator": ""}, (), 1),  # nobody holds them
        ({"equality": ""}, (), 0),  # one motor cannot hold two
        ({"equality": '<joint joint1="left" joint2="elbow"/>'}, (), 1),  # one follows what is read
        ({"equality": TO_BASE}, (), 1),  # a loop through what is read
        ({"equality": TO_BASE, "actuator": '<motor joint="right"/>'}, ("right",), 1),
        ({"equality": '<connect body1="left" body2="right" anchor="0 0 0"/>'}, ("left", "right"), 0),
        ({"base": BASE}, ("x", "z", "pitch", "left", "right"), 0),
        ({"base": BASE, "equality": '<joint joint1="elbow" joint2="pitch"/>'}, (), 1),  # tied to what is read
        ({"base": '<joint name="yaw" axis="0 0 1"/>'}, ("left", "right"), 0),  # a joint like any other
    ],
)
def test_joints_that_motors_hold_are_held_and_passive_ones_are_not(options, held, left):
    """`left` is the number of equalities that still act."""
    spec = robot(**options)
    assert held_joints(spec, ["elbow"]) == held
    model = suspended(spec, ["elbow"])
    assert {model.joint(number).name for number in range(model.njnt)} == {one.name for one in spec.joints} - set(held)
    assert model.neq == left


def test_a_lamp_beside_the_robot_is_no_base():
    text = (
        robot()
        .to_xml()
        .replace(
            "<worldbody>",
            '<worldbody><body name="lamp" pos="1 0 0"><joint name="cord" type="ball"/><geom size="0.1"/></body>',
        )
    )
    spec = mujoco.MjSpec.from_string(text.replace('<key qpos="0 0 0"/>', ""))
    assert held_joints(spec, ["elbow"]) == ("left", "right")


def test_inertia_that_a_tendon_couples_is_not_lost():
    heavy = SPLIT.replace('joint="right"', 'joint="elbow"').replace('name="split"', 'name="split" armature="0.5"')
    spec = robot(tendon=heavy, equality="", actuator=MOTOR)
    assert held_joints(spec, ["elbow"]) == ()
    assert suspended(spec, ["elbow"]).ntendon == 1


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


def test_a_spring_over_one_joint_couples_it_to_nothing():
    spring = '<fixed name="split" stiffness="9"><joint joint="elbow" coef="1"/></fixed>'
    assert independent_joints(robot(tendon=spring, actuator="", equality="")) == ("elbow", "left", "right")


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
