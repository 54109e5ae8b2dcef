"""The follower: makes a target the velocity commands that take a walking policy where the arm reaches it."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot import NUM_LEG_JOINTS, Robot
from wbc_bench.robot.kinematics import ArmKinematics
from wbc_bench.rotations import geodesic_angle, yaw_matrix

Array = NDArray[np.float64]
DISTANCES = np.array([0.25, 0.35, 0.45, 0.55, 0.65])  # [m] from the arm's mount to the target, horizontal
BEARINGS = np.arange(-150, 181, 30) * np.pi / 180  # [rad] of the mount as it is seen from the target
REACHED = 0.01, 0.05  # [m], [rad] a posture of the arm that comes so near reaches
STEPS, DAMPING = 40, 0.05  # of the arm's inverse kinematics
TURNING = 0.3  # [m/rad] what a turn costs beside the way
# [1] what errors beyond REACHED cost beside the way: 1 cm as much as a way of 1 m
UNREACHED = 100.0


class Follower:
    """Velocity commands (vx, vy, wz) of N robots.

    At the start of an episode it chooses, for each robot, a stance: a place of the level base at its present
    height, facing the target, from which the arm's inverse kinematics reaches the target's pose. Where it
    stands is one of the candidates; the one with the shortest way is taken, on which each centimetre or
    hundredth of a radian that the arm stays short counts a metre. The stance is kept as the base's pose seen
    from the target, so that no odometry is needed; it suits one target that stays where it is in the world.
    """

    def __init__(
        self,
        robot: Robot,
        gain: float,
        limits: tuple[float, float, float],
        tolerance: tuple[float, float],
    ) -> None:
        """Prepare for any number of robots.

        Args:
            robot: The robot whose arm reaches.
            gain: [1/s] Velocity for each metre or radian that is left.
            limits: [m/s], [m/s], [rad/s] Largest vx, vy, wz.
            tolerance: [m], [rad] Errors that are left alone.
        """
        self._arm = ArmKinematics(robot)
        self._default = robot.default_q[NUM_LEG_JOINTS:]
        self._gain, self._limits = gain, np.array(limits)
        self._still = np.array([tolerance[0], tolerance[0], tolerance[1]])

    def start(self, pos_h: Array, rot_h: Array) -> None:
        """Choose stances for targets (N, 3) [m], (N, 3, 3) in the heading frames.

        A heading frame is at the base, level, and turned with it, see `heading_from_gravity`.
        """
        place, yaw = self._candidates(pos_h)  # (N, K, 2) [m], (N, K) [rad]
        count, kinds = yaw.shape
        turn = yaw_matrix(yaw)
        offset = pos_h[:, None] - np.concatenate([place, np.zeros((count, kinds, 1))], axis=2)
        pos = np.einsum("nkji,nkj->nki", turn, offset).reshape(-1, 3)
        rot = np.einsum("nkji,njl->nkil", turn, rot_h).reshape(-1, 3, 3)
        q = self._arm.solve(np.tile(self._default, (len(pos), 1)), pos, rot, STEPS, DAMPING)
        got_pos, got_rot = self._arm.pose(q)
        miss = np.maximum(np.linalg.norm(got_pos - pos, axis=1) - REACHED[0], 0.0)
        miss += np.maximum(geodesic_angle(got_rot, rot) - REACHED[1], 0.0)
        cost = np.linalg.norm(place, axis=2) + TURNING * np.abs(yaw) + UNREACHED * miss.reshape(count, kinds)
        best = np.arange(count), np.argmin(cost, axis=1)
        # the base as it is seen from the target
        self._rot = np.swapaxes(rot_h, 1, 2) @ turn[best]
        self._pos = -np.einsum("nji,nj->ni", rot_h, offset[best])

    def command(self, pos_h: Array, rot_h: Array) -> Array:
        """(N, 3) [m/s, m/s, rad/s] in the heading frame, for targets as `start` takes them."""
        place = pos_h + np.einsum("nij,nj->ni", rot_h, self._pos)
        facing = (rot_h @ self._rot)[:, :2, 0]
        error = np.column_stack([place[:, :2], np.arctan2(facing[:, 1], facing[:, 0])])
        error = np.where(np.abs(error) < self._still, 0.0, error)
        return np.clip(self._gain * error, -self._limits, self._limits)

    def _candidates(self, pos_h: Array) -> tuple[Array, Array]:
        """Places (N, K, 2) [m] of the base in the heading frame, and its yaw (N, K); the first is here."""
        bearing, distance = (part.ravel() for part in np.meshgrid(BEARINGS, DISTANCES))
        mount = distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        yaw = np.arctan2(-mount[:, 1], -mount[:, 0])  # faces the target
        ahead = np.einsum("kij,j->ki", yaw_matrix(yaw)[:, :2, :2], self._arm.root[:2])
        place = pos_h[:, None, :2] + (mount - ahead)
        count = len(pos_h)
        place = np.concatenate([np.zeros((count, 1, 2)), place], axis=1)
        return place, np.tile(np.concatenate([[0.0], yaw]), (count, 1))
