"""Where the arm's joint positions put the end-effector, batched."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot import NUM_LEG_JOINTS, Robot, mount_of, tcp_of
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_rpy, rotvec_from_matrix

Array = NDArray[np.float64]


class ArmKinematics:
    """The chain from the base to the end-effector."""

    def __init__(self, robot: Robot) -> None:
        facts, config = robot.facts, robot.config
        self._joints = [(np.array(j.xyz), np.array(j.axis)) for j in facts.joints[NUM_LEG_JOINTS:]]
        tcp = tcp_of(facts, config)
        self._tcp, self._tcp_rot = np.array(tcp.xyz), matrix_from_rpy(np.array(tcp.rpy))

        self.root = np.array(mount_of(facts, config).xyz)  # (3,) [m] the arm's mount in the base frame
        lengths = [np.linalg.norm(xyz) for xyz, _ in self._joints] + [np.linalg.norm(self._tcp)]
        self.reach = float(np.sum(lengths))  # [m] from the mount, beyond which nothing is reached
        self._lower, self._upper = robot.lower[NUM_LEG_JOINTS:], robot.upper[NUM_LEG_JOINTS:]

    def pose(self, q: Array) -> tuple[Array, Array]:
        """End-effector poses (N, 3) [m], (N, 3, 3) in the base frame at J1..J6 (N, 6) [rad]."""
        pos, rot, _ = self.pose_and_jacobian(q)
        return pos, rot

    def pose_and_jacobian(self, q: Array) -> tuple[Array, Array, Array]:
        """Poses as in `pose`, and d(linear, angular velocity)/d(joint velocities) (N, 6, 6), base frame."""
        pos = np.tile(self.root, (len(q), 1))
        rot = np.tile(np.eye(3), (len(q), 1, 1))
        origins, axes = [], []
        for angle, (xyz, axis) in zip(q.T, self._joints, strict=True):
            pos = pos + rot @ xyz
            origins.append(pos)
            axes.append(rot @ axis)
            rot = rot @ matrix_from_rotvec(angle[:, None] * axis)
        pos, rot = pos + rot @ self._tcp, rot @ self._tcp_rot
        axis = np.stack(axes, axis=2)
        jacobian = np.empty((len(q), 6, 6))
        jacobian[:, :3] = np.cross(axis, pos[:, :, None] - np.stack(origins, axis=2), axis=1)
        jacobian[:, 3:] = axis
        return pos, rot, jacobian

    def step(self, q: Array, pos_b: Array, rot_b: Array, damping: float) -> Array:
        """One damped Gauss-Newton step (N, 6) [rad] from `q` (N, 6) towards poses in the base frame.

        Source: Nakamura & Hanafusa 1986 (damped least squares).
        """
        pos, rot, jacobian = self.pose_and_jacobian(q)
        error = np.concatenate([pos_b - pos, rotvec_from_matrix(rot_b @ np.swapaxes(rot, 1, 2))], axis=1)
        return damped_step(np.swapaxes(jacobian, 1, 2), error, damping**2)

    def solve(self, q: Array, pos_b: Array, rot_b: Array, steps: int, damping: float) -> Array:
        """Joint positions (N, 6) [rad] within their limits, near `q`, that come close to poses.

        Args:
            q: (N, 6) [rad] Where the search begins.
            pos_b: (N, 3) [m] Wanted positions in the base frame.
            rot_b: (N, 3, 3) Wanted rotations in the base frame.
            steps: Number of damped Gauss-Newton steps, each of at most 0.5 rad a joint.
            damping: Weight of a joint's motion [m/rad].
        """
        for _ in range(steps):
            moved = np.clip(self.step(q, pos_b, rot_b, damping), -0.5, 0.5)
            q = np.clip(q + moved, self._lower, self._upper)
        return q


def damped_step(transposed_jacobian: Array, error: Array, damping: float) -> Array:
    """Damped least squares J^T (J J^T + d)^-1 e, (N, K), of Jacobians J^T (N, K, M) and errors (N, M)."""
    gram = np.swapaxes(transposed_jacobian, -1, -2) @ transposed_jacobian + damping * np.eye(error.shape[1])
    multipliers = np.linalg.solve(gram, error[..., None])
    return (transposed_jacobian @ multipliers)[..., 0]
