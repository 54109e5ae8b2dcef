"""A target that follows a goal no faster than it may: what comes in jumps, what goes out does not."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.rotations import matrix_from_rotvec, rotvec_from_matrix

Array = NDArray[np.float64]


class Limits(NamedTuple):
    """Speeds of a target."""

    linear: float = 0.3  # [m/s]
    angular: float = 1.0  # [rad/s]


class Pose(NamedTuple):
    """A pose in whatever frame its owner says."""

    pos: Array  # (3,) [m]
    rot: Array  # (3, 3)


def between(a: Pose, b: Pose, part: float) -> Pose:
    """On the straight line and geodesic from a to b, 0 <= part <= 1."""
    turn = matrix_from_rotvec(part * rotvec_from_matrix(a.rot.T @ b.rot))
    return Pose(a.pos + part * (b.pos - a.pos), a.rot @ turn)


def slew(now: Pose, goal: Pose, seconds: float, limits: Limits) -> Pose:
    """The pose after `seconds` [s] on the straight line and geodesic to a goal, each at most at its limit."""
    way = goal.pos - now.pos
    turn = rotvec_from_matrix(now.rot.T @ goal.rot)
    step = min(1.0, limits.linear * seconds / max(float(np.linalg.norm(way)), 1e-12))
    part = min(1.0, limits.angular * seconds / max(float(np.linalg.norm(turn)), 1e-12))
    return Pose(now.pos + step * way, now.rot @ matrix_from_rotvec(part * turn))
