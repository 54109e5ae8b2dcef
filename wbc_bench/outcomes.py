"""What an evaluation leaves behind: the time series of a shard of episodes and how each ended."""

import enum
import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

STRATA = ("arm", "posture", "step")


class Outcome(enum.StrEnum):
    """How an episode ended; each has exactly one, so that counts add up to the episodes asked for."""

    SUCCESS = "success"  # both errors inside the tolerance at every step of the final window
    FELL = "fell"  # the base tilted or sank past the termination limits
    ILLEGAL_CONTACT = "illegal_contact"  # base, shank or arm touched the ground
    MISSED = "missed"  # stood, and was never inside the tolerance
    DRIFTED = "drifted"  # was inside the tolerance, and did not hold it through the window
    QP_INFEASIBLE = "qp_infeasible"  # stood, off target, its solver without a solution in the window
    INVALID = "invalid"  # the controller answered NaN, or the simulation diverged


TERMINATED = (Outcome.FELL, Outcome.ILLEGAL_CONTACT, Outcome.INVALID)


class SuccessRule(msgspec.Struct, frozen=True):
    """When an episode succeeds: both errors stay inside the tolerances throughout the final window.

    The defaults are those of every committed record that was written before records had this field.
    """

    position: float = 0.05  # [m]
    orientation: float = math.radians(7.0)  # [rad]
    window: float = 1.0  # [s]
    horizon: float = 10.0  # [s] of an episode that is not terminated


@dataclass(frozen=True)
class EpisodeBatch:
    """Time series of N episodes of at most T control steps; NaN after the end of an episode."""

    control_period: float  # [s]
    window: int  # control steps in the success window
    steps: NDArray[np.int64]  # (N,) control steps completed
    outcome: NDArray[np.object_]  # (N,) Outcome
    position_error: NDArray[np.float64]  # (N, T) [m]
    orientation_error: NDArray[np.float64]  # (N, T) [rad]
    action: NDArray[np.float64]  # (N, T, A) normalised: (command - default) / scale, or the controller's own
    command: NDArray[np.float64]  # (N, T, 14) [rad] positions; of equal torque where commands are more
    ee_pos_w: NDArray[np.float64]  # (N, T, 3) [m] end-effector in the world
    inside: NDArray[np.bool_]  # (N, T) both errors inside the tolerances
    work: NDArray[np.float64]  # (N, T) [J] positive mechanical work of the motors in a control step
    at_torque_limit: NDArray[np.bool_]  # (N, T) some joint was, within the control step
    at_speed_limit: NDArray[np.bool_]  # (N, T)
    slip: NDArray[np.float64]  # (N, T) [m] way of the loaded soles along the ground in a control step
    push_step: NDArray[np.int64]  # (N, P) control steps at whose start there was a push, -1 for none
    infeasible_steps: NDArray[np.int64]  # (N,) control steps on which the controller had no solution
