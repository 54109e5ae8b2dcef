"""The arm's own servo: keeps the hand on its pose in the base frame while the body sways."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.model import Pose, WholeBodyModel

Array = NDArray[np.float64]


def solve_arm(model: WholeBodyModel, joints: Array, pose_b: Pose, damping: float, limit: float) -> Array:
    """Arm joints (6,) [rad] near those of `joints` (14,) that put the hand at a pose in the base frame.

    Two damped Gauss-Newton steps; no joint moves further than `limit` [rad].
    Source: Nakamura & Hanafusa 1986 (damped least squares).
    """
    start = joints[8:]
    trial = joints.copy()
    for _ in range(2):
        (pos, rot), jacobian = model.arm_in_base(trial)
        error = np.concatenate([pose_b[0] - pos, rot @ pin.log3(rot.T @ pose_b[1])])
        gram = jacobian @ jacobian.T
        gram[np.diag_indices(6)] += damping**2
        trial[8:] += jacobian.T @ np.linalg.solve(gram, error)
    return start + np.clip(trial[8:] - start, -limit, limit)
