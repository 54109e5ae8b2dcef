"""The whole-body inverse kinematics as one quadratic program, in PlaCo."""

import contextlib

import numpy as np
import placo
from numpy.typing import NDArray
from wbc_bench.robot import JOINT_NAMES, Robot

from wbc_baselines.ik.model import Pose
from wbc_baselines.ik.settings import Weights

Array = NDArray[np.float64]


class PlacoIK:
    """One step of differential inverse kinematics over the floating base.

    Stateless between steps: the configuration goes in and comes out, so that one program serves all episodes.
    """

    def __init__(self, robot: Robot, weights: Weights, period: float) -> None:
        with _quiet():
            self._robot = wrapper = placo.RobotWrapper("", placo.Flags.ignore_collisions, robot.urdf())
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
        self._right = solver.add_position_task("sole_R", np.zeros(3))
        self._right.configure("right", "hard", 1.0)
        self._pitch = solver.add_orientation_task("sole_R", np.eye(3))
        self._pitch.configure("right_pitch", "hard", 1.0)
        self._pitch.mask.set_axises("y", "local")
        self._flat = solver.add_orientation_task("sole_R", np.eye(3))
        self._flat.configure("right_flat", "soft", weights.foot_flat)
        self._com = solver.add_com_task(np.zeros(3))
        self._com.mask.set_axises("xy")
        self._com.configure("com", "soft", weights.com)
        self._polygon = solver.add_com_polygon_constraint([np.zeros(2)] * 3, weights.com_margin)
        self._polygon.configure("polygon", "hard")
        self._posture = solver.add_joints_task()
        self._posture.configure("posture", "soft", weights.posture)
        solver.add_regularization_task(weights.regularization)

    def step(
        self,
        q: Array,
        ee: Pose,
        soles: list[Pose],
        hull: Array,
        posture: Array,
        limit_speed: bool = True,
    ) -> Array | None:
        """The configuration (21,) one step on, or None when the program has no solution.

        q: (21,) configuration to start from; ee, soles: poses asked for; hull: (V, 2) support polygon,
        counter-clockwise; posture: (14,) joint positions preferred. All in the anchor frame.
        """
        robot, solver = self._robot, self._solver
        robot.state.q = q
        robot.update_kinematics()
        self._ee.T_world_frame = _matrix(ee)
        self._left.T_world_frame = _matrix(soles[0])
        self._right.target_world = soles[1][0]
        self._pitch.R_world_frame = soles[1][1]
        self._flat.R_world_frame = soles[1][1]
        self._com.target_world = np.array([*hull.mean(axis=0), 0.0])
        self._polygon.polygon = list(hull[::-1])  # PlaCo wants it clockwise
        self._posture.set_joints(dict(zip(JOINT_NAMES, posture, strict=True)))
        solver.enable_velocity_limits(limit_speed)
        try:
            solver.solve(True)
        except RuntimeError:
            return None
        return np.array(robot.state.q)


def _matrix(pose: Pose) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose[1], pose[0]
    return matrix


def _quiet():
    return contextlib.nullcontext()
