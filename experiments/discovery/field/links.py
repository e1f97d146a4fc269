"""Where the links of many robots are and how they move, in plain arrays, and how links are loaded."""

import numpy as np

from experiments.discovery.field.robots import Robot


class Kinematics:
    """Velocities of links, and joint torques of forces on them, for lanes that share one geometry.

    Args:
      robot: whose geometry all lanes have.
    """

    def __init__(self, robot: Robot):
        self._robot = robot
        cross = np.zeros((len(robot.joints), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -robot.axis[:, 2], robot.axis[:, 1], -robot.axis[:, 0]
        self._cross = cross - cross.transpose(0, 2, 1)

    def com(self, link: int) -> np.ndarray:
        """Returns the centre of mass of a link in its frame, [3] m."""
        return self._robot.com[link]

    def jacobian(self, q: np.ndarray, link: int, point: np.ndarray) -> np.ndarray:
        """Returns how fast a point of a link moves for each joint's speed, [lanes, 3, joints] m.

        Args:
          q: [lanes, joints] rad.
          link: index of the link.
          point: [3] m in the link's frame.
        """
        robot, carriers, at = self._robot, [], link
        while at >= 0:
            carriers.append(at)
            at = robot.parents[at]
        turn = np.tile(np.eye(3), (len(q), 1, 1))
        origin, hinges = np.zeros((len(q), 3)), []
        for joint in reversed(carriers):
            origin = origin + turn @ robot.pos[joint]
            hinges.append((joint, origin, turn @ robot.axis[joint]))
            angle, cross = q[:, joint, None, None], self._cross[joint]
            # Rodrigues' formula.
            turn = turn @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))
        tip = origin + turn @ point
        found = np.zeros((len(q), 3, q.shape[1]))
        for joint, place, axis in hinges:
            found[:, :, joint] = np.cross(axis, tip - place)
        return found


def loaded(robot: Robot, link: int, kg: float, offset: np.ndarray, radius: float = 0.0) -> Robot:
    """Returns the robot with a ball fixed to a link.

    Args:
      robot: to be loaded.
      link: index of the link.
      kg: mass of the ball.
      offset: [3] m from the link's centre of mass to the ball's.
      radius: of the ball in m.
    """
    mass = robot.mass[link] + kg
    shift = offset * kg / mass

    def about(weight: float, arm: np.ndarray) -> np.ndarray:
        return weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))

    inertia = robot.inertia[link] + about(robot.mass[link], shift) + about(kg, offset - shift)
    inertia = inertia + 0.4 * kg * radius**2 * np.eye(3)
    changed = robot.with_at("inertia", link, inertia).with_at("com", link, robot.com[link] + shift)
    return changed.with_at("mass", link, mass)
