"""The whole-body inverse kinematics as one quadratic program, in PlaCo."""

import numpy as np
import placo
from numpy.typing import NDArray
from wbc_bench.robot import JOINT_NAMES, Robot

Array = NDArray[np.float64]


def _pose(pos: Array, rot: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rot, pos
    return matrix


class PlacoIK:
    """One step of differential inverse kinematics over the floating base."""

    def __init__(self, robot: Robot, weights, period: float) -> None:
        self._robot = wrapper = placo.RobotWrapper("", 0, robot.urdf())
        self._weights = weights
        self._solvers = {}
        margin = weights.joint_margin
        for name, lower, upper, speed in zip(JOINT_NAMES, robot.lower, robot.upper, robot.velocity, strict=True):
            wrapper.set_joint_limits(name, lower + margin, upper - margin)
            wrapper.set_velocity_limit(name, weights.speed_fraction * speed)
        self._solver = solver = wrapper.make_solver()
        solver.dt = period
        solver.enable_joint_limits(True)
        self._ee = solver.add_frame_task("tcp", np.eye(4))
        self._ee.configure("ee", "soft", weights.ee_position, weights.ee_orientation)
        # Two 6-D foot constraints have rank 10 of 12 on these 4-DoF legs: the right foot gives up roll and yaw.
        self._left = solver.add_frame_task("sole_L", np.eye(4))
        self._left.configure("left", "hard", 1.0, 1.0)
        self._right = solver.add_frame_task("sole_R", np.eye(4))
        self._right.position().configure("right_position", "hard", 1.0)
        self._right.orientation().configure("right_flat", "soft", weights.foot_flat)
        self._pitch = solver.add_orientation_task("sole_R", np.eye(3))
        self._pitch.configure("right_pitch", "hard", 1.0)
        self._pitch.mask.set_axises("y", "local")
        self._com = solver.add_com_task(np.zeros(3))
        self._com.mask.set_axises("xy")
        self._com.configure("com", "soft", weights.com)
        self._polygon = solver.add_com_polygon_constraint([np.zeros(2)] * 4, 0.0)
        self._polygon.configure("polygon", "soft", weights.polygon)
        self._posture = solver.add_joints_task()
        self._posture.configure("posture", "soft", weights.posture)
        solver.add_regularization_task(weights.regularization)

    def step(self, q, ee, feet, polygon, com, posture, limit_speed=True) -> Array | None:
        """The next configuration (21,), or None when the program has no solution."""
        robot, solver = self._robot, self._solver
        robot.state.q = q
        robot.update_kinematics()
        self._ee.T_world_frame = _pose(*ee)
        self._left.T_world_frame, self._right.T_world_frame = _pose(*feet[0]), _pose(*feet[1])
        self._pitch.R_world_frame = feet[1][1]
        self._com.target_world = com
        self._polygon.polygon = polygon
        self._posture.set_joints(dict(zip(JOINT_NAMES, posture, strict=True)))
        solver.enable_velocity_limits(limit_speed)
        try:
            solver.solve(True)
        except RuntimeError:
            return None
        return np.array(robot.state.q)
