"""Rotations, batched. The only module that knows wxyz (MuJoCo) from xyzw (Pinocchio, SciPy).

Everything else holds rotation matrices, (..., 3, 3); quaternions appear only where a library wants one.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrix_from_wxyz(quat: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), scalar first. Source: Diebel 2006."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rot = np.empty((*quat.shape[:-1], 3, 3))
    rot[..., 0, 0] = 1 - 2 * (y * y + z * z)
    rot[..., 0, 1] = 2 * (x * y - w * z)
    rot[..., 0, 2] = 2 * (x * z + w * y)
    rot[..., 1, 0] = 2 * (x * y + w * z)
    rot[..., 1, 1] = 1 - 2 * (x * x + z * z)
    rot[..., 1, 2] = 2 * (y * z - w * x)
    rot[..., 2, 0] = 2 * (x * z - w * y)
    rot[..., 2, 1] = 2 * (y * z + w * x)
    rot[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return rot


def wxyz_from_matrix(rot: Array) -> Array:
    """Unit quaternions (..., 4), scalar first and non-negative, of rotation matrices (..., 3, 3).

    A matrix that is not finite, e.g. of a simulation that diverged, has NaN and spoils no other.
    Source: Bar-Itzhack 2000 (largest eigenvector), exact for every angle.
    """
    finite = np.asarray(np.isfinite(rot).all(axis=(-2, -1), keepdims=True))
    m = np.where(finite, rot, np.eye(3))
    k = np.empty((*rot.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    k[..., 1, 1] = m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2]
    k[..., 2, 2] = m[..., 1, 1] - m[..., 0, 0] - m[..., 2, 2]
    k[..., 3, 3] = m[..., 2, 2] - m[..., 0, 0] - m[..., 1, 1]
    k[..., 0, 1] = k[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 1, 0] + m[..., 0, 1]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 2, 1] + m[..., 1, 2]
    quat = np.linalg.eigh(k)[1][..., :, 3]
    return np.where(finite[..., 0], np.where(quat[..., :1] < 0, -quat, quat), np.nan)


def xyzw_from_wxyz(quat: Array) -> Array:
    """Scalar-last copy of scalar-first quaternions (..., 4)."""
    return np.roll(quat, -1, axis=-1)


def wxyz_from_xyzw(quat: Array) -> Array:
    """Scalar-first copy of scalar-last quaternions (..., 4)."""
    return np.roll(quat, 1, axis=-1)


def matrix_from_rpy(rpy: Array) -> Array:
    """Rotation matrices (..., 3, 3) = Rz(yaw) Ry(pitch) Rx(roll) of angles (..., 3) [rad]. Source: URDF."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(rpy), -1, 0), np.moveaxis(np.sin(rpy), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def yaw_matrix(yaw: Array | float) -> Array:
    """Rotations (..., 3, 3) about the vertical by angles (...,) [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    rot = np.zeros((*np.shape(yaw), 3, 3))
    rot[..., 0, 0] = rot[..., 1, 1] = c
    rot[..., 1, 0], rot[..., 0, 1] = s, -s
    rot[..., 2, 2] = 1.0
    return rot


def rpy_from_matrix(rot: Array) -> Array:
    """Roll, pitch, yaw (..., 3) [rad] of rotation matrices (..., 3, 3), pitch in [-pi/2, pi/2]. Source: URDF.

    At a pitch of +-pi/2 only the sum or difference of the others is defined.
    """
    pitch = np.arctan2(-rot[..., 2, 0], np.hypot(rot[..., 0, 0], rot[..., 1, 0]))
    roll = np.arctan2(rot[..., 2, 1], rot[..., 2, 2])
    return np.stack([roll, pitch, np.arctan2(rot[..., 1, 0], rot[..., 0, 0])], axis=-1)


def matrix_from_rotvec(rotvec: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]. Source: Rodrigues' formula."""
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    hat = np.zeros((*rotvec.shape[:-1], 3, 3))
    hat[..., 0, 1], hat[..., 0, 2], hat[..., 1, 2] = -rotvec[..., 2], rotvec[..., 1], -rotvec[..., 0]
    hat -= np.swapaxes(hat, -1, -2)
    # sinc keeps both coefficients exact at angle zero
    return np.eye(3) + np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (hat @ hat)


def rotvec_from_matrix(rot: Array) -> Array:
    """Rotation vectors (..., 3) [rad], norm in [0, pi], of rotation matrices (..., 3, 3)."""
    quat = wxyz_from_matrix(rot)
    vec = quat[..., 1:]
    norm = np.linalg.norm(vec, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(norm, quat[..., :1])
    return np.where(norm > 1e-12, vec * angle / np.maximum(norm, 1e-12), 2 * vec)


def geodesic_angle(a: Array, b: Array) -> Array:
    """Angle (...,) [rad] of the rotation between matrices (..., 3, 3), exact near 0, to 1e-7 near pi.

    Source: paper, "geodesic distance between rotation matrices"; ||a - b||_F = 2 sqrt(2) sin(angle / 2).
    """
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / (2 * np.sqrt(2))
    return 2 * np.arcsin(np.minimum(chord, 1.0))


def rho6(rot: Array) -> Array:
    """First two columns (..., 6) of rotation matrices (..., 3, 3). Source: paper eq. 1 (Zhou et al. 2019)."""
    return np.concatenate([rot[..., :, 0], rot[..., :, 1]], axis=-1)


def matrix_from_rho6(columns: Array) -> Array:
    """Rotation matrices (..., 3, 3) of two noisy columns (..., 6), by Gram-Schmidt.

    Source: Zhou et al. 2019, "On the Continuity of Rotation Representations", eq. 15.
    """
    x, y = columns[..., :3], columns[..., 3:]
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = y - (x * y).sum(axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def heading_from_gravity(gravity: Array) -> Array:
    """Rotations (N, 3, 3) from frames to those with their heading that are level.

    Args:
        gravity: (N, 3) Direction of gravity in the frames, of any length, not along their x axes.
    """
    up = -gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    x = np.array([1.0, 0.0, 0.0]) - up * up[:, :1]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(up, x), up], axis=1)
