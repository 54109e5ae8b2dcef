"""The frame in which static postures are solved: on the ground, below the default base, x forward."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.rotations import matrix_from_rpy

Array = NDArray[np.float64]


class GroundFrame(NamedTuple):
    """Where the robot stands: origin on the ground [m] and heading [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0


def from_ground_frame(frame: GroundFrame, pos: Array, rot: Array) -> tuple[Array, Array]:
    """World pose (..., 3), (..., 3, 3) of a pose given in the ground frame."""
    turn = matrix_from_rpy(np.array([0.0, 0.0, frame.yaw]))
    return pos @ turn.T + [frame.x, frame.y, 0.0], turn @ rot


def to_ground_frame(frame: GroundFrame, pos: Array, rot: Array) -> tuple[Array, Array]:
    """Pose (..., 3), (..., 3, 3) in the ground frame of a world pose."""
    turn = matrix_from_rpy(np.array([0.0, 0.0, frame.yaw]))
    return (pos - [frame.x, frame.y, 0.0]) @ turn, turn.T @ rot
