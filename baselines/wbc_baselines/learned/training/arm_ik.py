"""Batched inverse kinematics and gravity compensation of the arm alone.

By reinforcement learning a policy needs tens of millions of control steps to discover how the arm reaches a
target, which inverse kinematics computes directly.

Source: Nakamura, Hanafusa 1986, "Inverse kinematic solutions with singularity robustness for robot
manipulator control", for the damping.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from wbc_baselines.learned.training.poses import rotation_from_rho6, twice_sine
from wbc_bench.robot import NUM_LEG_JOINTS, Robot

ROTATION_WEIGHT = 0.3  # [m/rad] weight of the orientation relative to the position; choice
DAMPING = 0.05  # [m/rad]; choice
STEPS, LONGEST = 8, 0.3  # Gauss-Newton steps, and the largest joint rotation per step [rad]; choice
MARGIN = 0.05  # [rad] distance kept from the joint limits; choice
GRAVITY = 9.81  # [m/s^2]


class ArmKinematics:
    """The arm as joint axes and masses in the base frame, at joint angles of zero."""

    def __init__(self, robot: Robot, device: torch.device | str = "cpu") -> None:
        model = robot.model()
        data = mujoco.MjData(model)
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)  # at joint angles of zero, the base at the origin
        tcp = model.site("tcp").id
        first = 1 + NUM_LEG_JOINTS  # after the free joint

        def tensor(array) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._anchor, self._axis = tensor(data.xanchor[first:]), tensor(data.xaxis[first:])
        self._cross = torch.stack([cross_matrix(axis) for axis in self._axis])
        self._one = torch.eye(3, device=device)
        self._pos, self._rot = tensor(data.site_xpos[tcp]), tensor(data.site_xmat[tcp].reshape(3, 3))
        self._link = tensor(data.xmat[model.site_bodyid[tcp]].reshape(3, 3))
        self._mass, self._com = (tensor(x) for x in _lumps(model, data, first))
        self._lower = tensor(robot.lower[NUM_LEG_JOINTS:]) + MARGIN
        self._upper = tensor(robot.upper[NUM_LEG_JOINTS:]) - MARGIN

    def hand(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute pose and Jacobian of the hand in the base frame.

        Args:
            q: (N, 6) [rad] Arm joints.

        Returns:
            Position (N, 3) [m], rotation (N, 3, 3) and Jacobian (N, 6, 6), whose rows are the linear, then
            the angular velocity.
        """
        axis, anchor, rot, shift = self._chain(q)
        pos = rot[-1] @ self._pos + shift[-1]
        linear = torch.linalg.cross(axis, pos[:, None] - anchor)
        return pos, rot[-1] @ self._rot, torch.cat([linear, axis], -1).transpose(1, 2)

    def pose(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Compute position (N, 3) [m] and rotation (N, 3, 3) of the hand in the base frame, see `hand`."""
        _, _, rot, shift = self._chain(q)
        return rot[-1] @ self._pos + shift[-1], rot[-1] @ self._rot

    def holding_torque(
        self, q: Tensor, gravity_b: Tensor, payload: Tensor | None = None, place: Tensor | None = None
    ) -> Tensor:
        """Compute the torques that hold the arm and a payload at rest.

        Args:
            q: (N, 6) [rad] Arm joints.
            gravity_b: (N, 3) Unit vector that points down, base frame.
            payload: (N, 1) [kg] Mass in the hand; None for an empty one.
            place: (N, 3) [m] Where it is from the hand, in the frame of the hand's link.

        Returns:
            Torques (N, 6) [N m].
        """
        axis, anchor, rot, shift = self._chain(q)
        torque = torch.zeros_like(q)
        for k, (mass, com) in enumerate(zip(self._mass, self._com, strict=True)):
            arm = (rot[k] @ com + shift[k])[:, None] - anchor[:, : k + 1]
            weight = (GRAVITY * mass * gravity_b)[:, None]
            torque[:, : k + 1] -= (torch.linalg.cross(arm, weight.expand_as(arm)) * axis[:, : k + 1]).sum(-1)
        if payload is not None and place is not None:
            point = rot[-1] @ self._pos + shift[-1] + ((rot[-1] @ self._link) @ place[..., None])[..., 0]
            arm, weight = point[:, None] - anchor, (GRAVITY * payload * gravity_b)[:, None]
            torque -= (torch.linalg.cross(arm, weight.expand_as(arm)) * axis).sum(-1)
        return torque

    def _chain(self, q: Tensor) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor]]:
        """Axes and anchors (N, 6, 3) of the joints; of each link rotation (N, 3, 3) and shift (N, 3)."""
        rot = self._one.expand(len(q), 3, 3)
        shift = torch.zeros(len(q), 3, device=q.device)
        axes, anchors, rots, shifts = [], [], [], []
        for k, (axis, anchor) in enumerate(zip(self._axis, self._anchor, strict=True)):
            axes.append(rot @ axis)
            anchors.append(rot @ anchor + shift)
            turn = rotation_about(self._cross[k], q[:, k])
            shift = shift + (rot @ (anchor - turn @ anchor)[..., None])[..., 0]
            rot = rot @ turn
            rots.append(rot)
            shifts.append(shift)
        return torch.stack(axes, 1), torch.stack(anchors, 1), rots, shifts

    def solve(self, q: Tensor, command: Tensor) -> Tensor:
        """Solve for arm joints that bring the hand as near as possible to its target.

        Args:
            q: (N, 6) [rad] Arm joints from which the search starts.
            command: (N, 9) Target position [m] and two columns of the target rotation, base frame.

        Returns:
            Arm joints (N, 6) [rad] within the joint limits.
        """
        wanted = rotation_from_rho6(command[:, 3:])
        weight = torch.tensor([1.0] * 3 + [ROTATION_WEIGHT] * 3, device=q.device)
        damping = DAMPING**2 * torch.eye(q.shape[1], device=q.device)
        for _ in range(STEPS):
            pos, rot, jacobian = self.hand(q)
            error = torch.cat([command[:, :3] - pos, rotation_vector(wanted @ rot.transpose(1, 2))], -1)
            weighted = jacobian * weight[:, None]
            normal = weighted.transpose(1, 2) @ weighted + damping
            right = (weighted.transpose(1, 2) @ (weight * error)[..., None])[..., 0]
            step = torch.linalg.solve(normal, right).clamp(-LONGEST, LONGEST)
            q = torch.minimum(torch.maximum(q + step, self._lower), self._upper)
        return q


def _lumps(model: mujoco.MjModel, data: mujoco.MjData, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Mass (6,) [kg] and its centre (6, 3) [m] of what hangs rigidly on each joint, from joint `first` on."""
    count = model.njnt - first
    mass, moment = np.zeros(count), np.zeros((count, 3))
    for body in range(1, model.nbody):
        carrier = body
        while model.body_jntnum[carrier] == 0:
            carrier = model.body_parentid[carrier]
        k = model.body_jntadr[carrier] - first
        if k >= 0:
            mass[k] += model.body_mass[body]
            moment[k] += model.body_mass[body] * data.xipos[body]
    return mass, moment / mass[:, None]


def cross_matrix(axis: Tensor) -> Tensor:
    """Return the matrix (3, 3) whose product with a vector is the cross product of `axis` (3,) with it."""
    x, y, z = axis.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], device=axis.device)


def rotation_about(cross: Tensor, angle: Tensor) -> Tensor:
    """Compute rotations about a fixed axis.

    Args:
        cross: (3, 3) `cross_matrix` of the unit axis.
        angle: (N,) [rad] Angles.

    Returns:
        Rotation matrices (N, 3, 3).

    Source: Rodrigues' formula.
    """
    sin, cos = angle.sin()[:, None, None], angle.cos()[:, None, None]
    return torch.eye(3, device=cross.device) + sin * cross + (1 - cos) * (cross @ cross)


def rotation_vector(rot: Tensor) -> Tensor:
    """Convert rotations (N, 3, 3) to rotation vectors (N, 3) [rad]; near a half turn the axis is inexact."""
    axis = twice_sine(rot)
    length = torch.linalg.vector_norm(axis, dim=-1)
    cosine = (rot.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(length / 2, cosine)
    return axis * (angle / length.clamp(min=1e-6))[:, None]
