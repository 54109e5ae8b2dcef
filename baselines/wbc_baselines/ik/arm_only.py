"""`ik:arm`: inverse kinematics of the arm alone, on legs that stand or that another controller moves."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.robot import NUM_LEG_JOINTS, Robot
from wbc_bench.robot.kinematics import ArmKinematics

Array = NDArray[np.float64]
PERIOD = 0.02  # [s]
GAIN = 3.0  # [1/s] of the error at the measured joints
FASTEST = 1.0  # [rad/s]
DAMPING = 0.05  # [m/rad]


class ArmController:
    """Resolved-rate control of the arm: its commands move at the speed that takes the hand to the target.

    The speed is that of the error at the measured joints, so that the commands go on until what weight, a
    payload and soft drives hold back is made up for. While a target is out of reach the arm goes to its
    default posture. Source: Whitney 1969 (resolved motion rate control), with damped least squares.
    """

    def __init__(self, robot: Robot) -> None:
        self.info = ControllerInfo(
            "ik:arm", frozenset({"proprioception"}), PERIOD, "wbc_baselines.ik.arm_only"
        )
        self._robot, self._arm = robot, ArmKinematics(robot)
        arm = slice(NUM_LEG_JOINTS, None)
        self._lower, self._upper, self._default = robot.lower[arm], robot.upper[arm], robot.default_q[arm]
        self._furthest = robot.effort[arm] / robot.kp[arm]  # [rad] beyond which a motor exerts no more

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Begin in the default posture."""
        self._command = np.tile(self._default, (len(episodes), 1))

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """The default posture of the legs and the arm's next commands, (N, 14) [rad]."""
        assert obs.proprioception is not None  # declared
        joints = obs.proprioception.joint_pos[:, NUM_LEG_JOINTS:]
        near = np.linalg.norm(target.pos_b - self._arm.root, axis=1) < self._arm.reach
        speed = GAIN * np.where(
            near[:, None],
            self._arm.step(joints, target.pos_b, target.rot_b, DAMPING),
            self._default - self._command,
        )
        command = self._command + PERIOD * np.clip(speed, -FASTEST, FASTEST)
        command = np.clip(command, joints - self._furthest, joints + self._furthest)
        self._command = np.clip(command, self._lower, self._upper)
        q = np.tile(self._robot.default_q, (len(joints), 1))
        q[:, NUM_LEG_JOINTS:] = self._command
        return JointCommand(q)
