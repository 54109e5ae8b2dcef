"""Vectors and rotations of N episodes at once, quick for the few rows of a shard.

No result depends on what else is in the batch: sums have three terms, and products are made row by row.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.rows import Rows
from wbc_bench.rotations import matrix_from_rotvec, rotvec_from_matrix

Array = NDArray[np.float64]
_YZX = [1, 2, 0]
NEAR_PI = -0.99  # cosine of an angle beyond which its axis no longer shows in the antisymmetric part
SMALL = 1e-4  # [rad] below which a series is more exact than the quotient


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3)."""
    return (a * b[..., _YZX] - a[..., _YZX] * b)[..., _YZX]


def rotate(rot: Array, vectors: Array) -> Array:
    """Vectors (..., 3) turned by rotation matrices (..., 3, 3)."""
    return (rot @ vectors[..., None])[..., 0]


def rotate_back(rot: Array, vectors: Array) -> Array:
    """Vectors (..., 3) turned by the inverses of rotation matrices (..., 3, 3)."""
    return (vectors[..., None, :] @ rot)[..., 0, :]


def transposed(matrices: Array) -> Array:
    """Transposes of matrices (..., M, N)."""
    return np.swapaxes(matrices, -1, -2)


def dot(a: Array, b: Array) -> Array:
    """Scalar products (...,) of vectors (..., 3) or (..., 2)."""
    return (a * b).sum(axis=-1)


def norm(vectors: Array) -> Array:
    """Euclidean lengths (...,) of vectors (..., 3) or (..., 2)."""
    return np.sqrt(dot(vectors, vectors))


def skew(vectors: Array) -> Array:
    """Matrices (..., 3, 3) that multiply as the cross products with vectors (..., 3)."""
    out = np.zeros((*vectors.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -vectors[..., 0], -vectors[..., 1], -vectors[..., 2]
    return out


def log3(rot: Array) -> Array:
    """Rotation vectors (..., 3) [rad], norm in [0, pi], of rotation matrices (..., 3, 3)."""
    flat = rot.reshape(*rot.shape[:-2], 9)
    sine_axis = 0.5 * (flat[..., [7, 2, 3]] - flat[..., [5, 6, 1]])
    sine = norm(sine_axis)
    cosine = 0.5 * (flat[..., 0] + flat[..., 4] + flat[..., 8] - 1.0)
    stretch = np.where(sine > SMALL, np.arctan2(sine, cosine) / np.maximum(sine, SMALL), 1 + sine * sine / 6)
    rotvec = stretch[..., None] * sine_axis
    far = cosine < NEAR_PI
    if far.any():
        rotvec[far] = rotvec_from_matrix(rot[far])
    return rotvec


def turn(rot: Array, target: Array, fraction: Array | float) -> Array:
    """Rotations a fraction of the way from some (..., 3, 3) to others along the geodesic."""
    return rot @ matrix_from_rotvec(np.asarray(fraction)[..., None] * log3(transposed(rot) @ target))


@dataclass
class Pose(Rows):
    """Poses of N frames in another."""

    pos: Array  # (N, 3) [m]
    rot: Array  # (N, 3, 3)

    def at(self, pos: Array, rot: Array) -> "Pose":
        """Poses (N, 3) [m], (N, 3, 3) in these frames, in the frame of these."""
        return Pose(self.pos + rotate(self.rot, pos), self.rot @ rot)

    def moved(self, twist: Array) -> "Pose":
        """After a unit of time at twists (N, 6) in these frames, linear over angular.

        Source: the exponential of SE(3), Murray, Li & Sastry 1994, eq. 2.36.
        """
        linear, angular = twist[:, :3], twist[:, 3:]
        angle = norm(angular)[:, None]
        once = cross(angular, linear)
        half = np.sinc(angle / (2 * np.pi))
        rest = (1.0 - np.sinc(angle / np.pi)) / np.maximum(angle, SMALL) ** 2
        rest = np.where(angle > SMALL, rest, 1.0 / 6.0)
        way = linear + 0.5 * half * half * once + rest * cross(angular, once)
        return Pose(self.pos + rotate(self.rot, way), self.rot @ matrix_from_rotvec(angular))
