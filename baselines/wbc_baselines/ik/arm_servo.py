"""The arm's own servo: keeps the hand on its pose in the base frame while the body sways."""

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import Pose, log3, rotate, transposed
from wbc_baselines.ik.kinematics import TCP, Bodies, Kinematics
from wbc_bench.robot.kinematics import damped_step

Array = NDArray[np.float64]


def solve_arm(
    kinematics: Kinematics, joints: Array, bodies: Bodies, hand_b: Pose, damping: float, limit: float
) -> Array:
    """Arm joints (N, 6) [rad] near those of `joints` (N, 14) that put the hands at poses in the base frame.

    Two damped Gauss-Newton steps, the first from the kinematics at these joints, `bodies`; no joint moves
    further than `limit` [rad]. Source: Nakamura & Hanafusa 1986 (damped least squares).
    """
    trial = joints.copy()
    trial[:, 8:] += _arm_step(bodies, hand_b, damping)
    trial[:, 8:] += _arm_step(kinematics.at(trial), hand_b, damping)
    return joints[:, 8:] + np.clip(trial[:, 8:] - joints[:, 8:], -limit, limit)


def _arm_step(bodies: Bodies, hand_b: Pose, damping: float) -> Array:
    rot = bodies.rot[:, TCP]
    turning = rotate(rot, log3(transposed(rot) @ hand_b.rot))
    error = np.concatenate([hand_b.pos - bodies.pos[:, TCP], turning], axis=1)
    jacobian = np.concatenate([bodies.linear[:, 8:], bodies.axis[:, 8:]], axis=2)  # (N, 6, 6) transposed
    return damped_step(jacobian, error, damping**2)
