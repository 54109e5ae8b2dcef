"""Where the arm's joint positions put the end-effector, batched."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot import NUM_LEG_JOINTS, Robot, mount_of, tcp_of
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_rpy

Array = NDArray[np.float64]


class ArmKinematics:
    """The chain from the base to the end-effector."""

    def __init__(self, robot: Robot) -> None:
        facts, config = robot.facts, robot.config
        self._root = np.array(mount_of(facts, config).xyz)
        self._joints = [(np.array(j.xyz), np.array(j.axis)) for j in facts.joints[NUM_LEG_JOINTS:]]
        tcp = tcp_of(facts, config)
        self._tcp, self._tcp_rot = np.array(tcp.xyz), matrix_from_rpy(np.array(tcp.rpy))

    def pose(self, q: Array) -> tuple[Array, Array]:
        """End-effector poses (N, 3) [m], (N, 3, 3) in the base frame at J1..J6 (N, 6) [rad]."""
        pos = np.tile(self._root, (len(q), 1))
        rot = np.tile(np.eye(3), (len(q), 1, 1))
        for angle, (xyz, axis) in zip(q.T, self._joints, strict=True):
            pos = pos + rot @ xyz
            rot = rot @ matrix_from_rotvec(angle[:, None] * axis)
        return pos + rot @ self._tcp, rot @ self._tcp_rot
