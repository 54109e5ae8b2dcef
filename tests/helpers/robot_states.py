"""States of the robot as a source sees them."""

import numpy as np

from wbc_bench.rotations import matrix_from_rpy
from wbc_bench.sources import Seen


def seen_at(yaw: float = 0.0, base_pos: tuple[float, float, float] = (0.0, 0.0, 0.84)) -> Seen:
    """A base turned about the vertical, the hand 0.39 m ahead and 0.31 m above it."""
    rot = matrix_from_rpy(np.array([0.0, 0.0, yaw]))
    base = np.array(base_pos)
    return Seen(base + rot @ [0.39, 0.0, 0.31], rot, base, rot, np.array([0.02, 0.0, 0.03]))
