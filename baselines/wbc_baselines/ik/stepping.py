"""A step of one foot to where the falling centre of mass can be caught.

While both feet stand, contact forces alone keep the capture point over the soles. Once it has left their hull
no force can bring it back, and one foot is put where it will be. Source: Pratt et al. 2006 (capture point);
Koolen et al. 2012, eq. 10 (its motion about a centre of pressure, here the near end of the standing sole).
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.model import Pose, WholeBodyModel, leg_of
from wbc_baselines.ik.stance import Stance, half_planes, yaw_matrix

Array = NDArray[np.float64]
MISS = 5.0  # a metre missed counts as this many metres of way; choice
LEG_DAMPING = 1e-4  # [m^2] of the leg's inverse kinematics near singular postures; choice
OUTWARD = (1.0, -1.0)  # sign of y on the side of the left and of the right foot


class Landing(NamedTuple):
    """Where a foot is to be put, and how far from there the capture point will be."""

    xy: Array  # (2,) [m] of the sole in the anchor frame
    miss: float  # [m] of the place that would be best from the nearest that the leg reaches


class Swing:
    """A foot on its way, in joint space: the leg starts and ends at rest."""

    def __init__(self, side: int, duration: float, lift_off: Array) -> None:
        self.side = side
        self.time, self.duration = 0.0, duration  # [s]
        self.landing: Landing | None = None
        self._start = lift_off  # (4,) [rad]

    @property
    def left(self) -> float:
        """Time [s] until the foot is to land."""
        return max(0.0, self.duration - self.time)

    def follow(self, goal: Array, raised: Array) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (4,) of the leg now, for a landing and a raised posture.

        Source: minimum jerk, Flash & Hogan 1985; the foot rises and sinks as 16 s^2 (1 - s)^2.
        """
        s = min(1.0, self.time / self.duration)
        way = np.array(
            [10 * s**3 - 15 * s**4 + 6 * s**5, 30 * (s - s**2) ** 2, 60 * s * (1 - s) * (1 - 2 * s)]
        )
        rise = 16 * np.array([s**2 * (1 - s) ** 2, 2 * s * (1 - s) * (1 - 2 * s), 2 * (1 - 6 * s + 6 * s**2)])
        rate = self.duration ** -np.arange(3.0)
        across, up = goal - self._start, raised - 0.5 * (self._start + goal)
        pos, vel, acc = rate[:, None] * (way[:, None] * across + rise[:, None] * up)
        return self._start + pos, vel, acc


def outside(point: Array, hull: Array) -> float:
    """How far [m] a point (2,) is outside a counter-clockwise convex hull (V, 2); negative inside."""
    normal, _ = half_planes(hull)
    return float(((point - hull) * normal).sum(axis=1).max())


def center_of_pressure(point: Array, xy: Array, yaw: float, corners: Array) -> Array:
    """The point (2,) of a sole at `xy`, `yaw` that is nearest to another: where its force acts."""
    rot = yaw_matrix(yaw)[:2, :2]
    inside = np.clip(rot.T @ (point - xy), corners[:, :2].min(axis=0), corners[:, :2].max(axis=0))
    return xy + rot @ inside


def plan_foothold(
    s: IKConfig, stance: Stance, side: int, capture: Array, rate: float, left: float, corners: Array
) -> Landing:
    """Where foot `side` is to land in `left` [s], from the capture point (2,) now.

    The capture point runs away from the other sole's pressure p as xi = p + (xi_0 - p) exp(omega t).
    """
    stand = 1 - side
    xy, yaw = stance.xy[stand], float(stance.yaw[stand])
    p = center_of_pressure(capture, xy, yaw, corners)
    rot = yaw_matrix(yaw)[:2, :2]
    ahead = rot.T @ (p + (capture - p) * np.exp(rate * left) - xy)  # (2,) seen from the standing sole
    middle = 0.5 * (corners[:, 0].min() + corners[:, 0].max())
    x = ahead[0] - middle
    y = OUTWARD[side] * ahead[1] + s.step_beside
    reach_x = np.clip(x, -s.step_length, s.step_length)
    reach_y = np.clip(y, s.step_width[0], s.step_width[1])
    # a foot further out than needed is no miss: the capture point is then between the feet
    miss = abs(x - reach_x) + max(0.0, y - reach_y)
    return Landing(xy + rot @ np.array([reach_x, OUTWARD[side] * reach_y]), float(miss))


def choose_swing_foot(s: IKConfig, stance: Stance, capture: Array, rate: float, corners: Array) -> int:
    """The foot to step with: the one whose landing misses least, then the one that has less far to go."""
    cost = []
    for side in (0, 1):
        where = plan_foothold(s, stance, side, capture, rate, s.step_duration, corners)
        cost.append(MISS * where.miss + float(np.linalg.norm(where.xy - stance.xy[side])))
    return int(np.argmin(cost))


def solve_leg(model: WholeBodyModel, joints: Array, side: int, pose_b: Pose) -> Array:
    """Leg joints (4,) [rad] near those of `joints` (14,) that put a sole at a position, its toe at a pitch.

    Damped Gauss-Newton; without an ankle roll the sole's roll and yaw follow.
    """
    leg = leg_of(side)
    trial = joints.copy()
    for _ in range(4):
        (pos, rot), jacobian = model.leg_in_base(trial, side)
        error = np.empty(4)
        error[:3] = pose_b[0] - pos
        axis = rot[:, 1]
        error[3] = axis @ (rot @ pin.log3(rot.T @ pose_b[1]))
        rows = np.concatenate([jacobian[:3], (axis @ jacobian[3:])[None]])
        gram = rows @ rows.T
        gram[np.diag_indices(4)] += LEG_DAMPING
        trial[leg] += rows.T @ np.linalg.solve(gram, error)
    return trial[leg]
