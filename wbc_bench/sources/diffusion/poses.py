"""Poses as UMI writes them: axes of its tool frame, relative to the present pose, rotations as six numbers.

UMI's six numbers are the first two rows of the matrix, ours in `rotations.rho6` the first two columns.
Source: real-stanford/universal_manipulation_interface@c34ba9c umi/common/pose_util.py (mat_to_rot6d),
diffusion_policy/common/pose_repr_util.py (pose_rep "relative").
"""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.rotations import matrix_from_rho6, rho6
from wbc_bench.sources.adapters import EE_FROM_UMI_TCP
from wbc_bench.sources.slew import Pose

Array = NDArray[np.float64]
POSE = 9  # numbers of a pose: position, six of the rotation


def tool(hand: Pose) -> Pose:
    """The hand (x forward, z up) in the axes of UMI's tool frame (z forward, y down)."""
    return Pose(hand.pos, hand.rot @ EE_FROM_UMI_TCP)


def hand(tool: Pose) -> Pose:
    """The inverse of `tool`."""
    return Pose(tool.pos, tool.rot @ EE_FROM_UMI_TCP.T)


def relative(pose: Pose, base: Pose) -> Pose:
    """Poses (..., 3), (..., 3, 3) as seen from a base (3,), (3, 3), or from (..., 3), (..., 3, 3)."""
    turned = np.swapaxes(base.rot, -1, -2)
    return Pose(np.einsum("...ij,...j->...i", turned, pose.pos - base.pos), turned @ pose.rot)


def absolute(pose: Pose, base: Pose) -> Pose:
    """The inverse of `relative`."""
    return Pose(base.pos + np.einsum("...ij,...j->...i", base.rot, pose.pos), base.rot @ pose.rot)


def numbers(pose: Pose) -> Array:
    """Poses as (..., 9)."""
    return np.concatenate([pose.pos, rho6(np.swapaxes(pose.rot, -1, -2))], axis=-1)


def pose_of(values: Array) -> Pose:
    """Poses of (..., 9) whose six numbers need not be orthonormal."""
    return Pose(values[..., :3], np.swapaxes(matrix_from_rho6(values[..., 3:]), -1, -2))
