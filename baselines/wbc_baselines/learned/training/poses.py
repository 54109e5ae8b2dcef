"""Rotations and errors between poses as tensors, for training; see `wbc_bench.rotations` for arrays."""

import torch
from torch import Tensor


def rotation_from_rho6(rho6: Tensor) -> Tensor:
    """Orthonormalize two noisy columns (N, 6) to rotation matrices (N, 3, 3) by Gram-Schmidt.

    Source: Zhou et al. 2019, "On the Continuity of Rotation Representations", eq. 15.
    """
    x, y = rho6[..., :3], rho6[..., 3:]
    x = torch.nn.functional.normalize(x, dim=-1)
    y = torch.nn.functional.normalize(y - (x * y).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def twice_sine(rot: Tensor) -> Tensor:
    """Compute the axes (N, 3) of rotations (N, 3, 3), with a length of twice the sine of the angle."""
    skew = rot - rot.transpose(1, 2)
    return torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)


def pose_errors(pos: Tensor, rot: Tensor, target_pos: Tensor, target_rot: Tensor) -> tuple[Tensor, Tensor]:
    """Compute position errors (N,) [m] and geodesic angles (N,) [rad] between poses in one frame.

    Source: paper, section III-D; ||a - b||_F = 2 sqrt(2) sin(angle / 2).
    """
    chord = torch.linalg.matrix_norm(rot - target_rot) / (2 * 2**0.5)
    return torch.linalg.vector_norm(pos - target_pos, dim=-1), 2 * torch.arcsin(chord.clamp(max=1.0))
