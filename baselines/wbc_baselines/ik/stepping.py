"""A step of one foot to where the falling centre of mass can be caught. Batched over episodes.

While both feet stand, contact forces alone keep the capture point over the soles. Once it has left their hull
no force can bring it back, and one foot is put where it will be. Source: Pratt et al. 2006 (capture point);
Koolen et al. 2012, eq. 10 (its motion about a centre of pressure, here the near end of the standing sole).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.geometry import dot, log3, norm, rotate, rotate_back, transposed
from wbc_baselines.ik.kinematics import SOLES, Kinematics
from wbc_baselines.ik.rows import Rows
from wbc_baselines.ik.stance import Stance
from wbc_bench.robot.kinematics import damped_step
from wbc_bench.rotations import yaw_matrix

Array = NDArray[np.float64]
Sides = NDArray[np.int64]  # (N,) 0 for the left foot, 1 for the right one
MISS = 5.0  # a metre missed counts as this many metres of way; choice
LEG_DAMPING = 1e-4  # [m^2] of the leg's inverse kinematics near singular postures; choice
OUTWARD = np.array([1.0, -1.0])  # sign of y on the side of the left and of the right foot
STANDING = -1  # instead of a side: no foot swings
LEGS = np.arange(8).reshape(2, 4)  # joints of the left and of the right leg


@dataclass
class Swing(Rows):
    """Feet on their way, in joint space: a leg starts and ends at rest."""

    side: Sides  # (N,) of the swinging foot, or STANDING
    time: Array  # (N,) [s] since lift-off
    landing: Array  # (N, 2) [m] of the sole in the anchor frame; NaN until it is planned
    start: Array  # (N, 4) [rad] of the leg at lift-off

    @classmethod
    def none(cls, count: int) -> "Swing":
        """All feet stand."""
        return cls(
            np.full(count, STANDING), np.zeros(count), np.full((count, 2), np.nan), np.zeros((count, 4))
        )

    def left(self, duration: float) -> Array:
        """Time (N,) [s] until the feet are to land."""
        return np.maximum(0.0, duration - self.time)

    def follow(self, duration: float, goal: Array, raised: Array) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (N, 4) of the legs, for landing and raised postures (N, 4).

        Source: minimum jerk, Flash & Hogan 1985; the foot rises and sinks as 16 s^2 (1 - s)^2.
        """
        s = np.minimum(1.0, self.time / duration)[:, None]
        way = 10 * s**3 - 15 * s**4 + 6 * s**5, 30 * (s - s**2) ** 2, 60 * s * (1 - s) * (1 - 2 * s)
        rise = s**2 * (1 - s) ** 2, 2 * s * (1 - s) * (1 - 2 * s), 2 * (1 - 6 * s + 6 * s**2)
        across, up = goal - self.start, raised - 0.5 * (self.start + goal)
        pos, vel, acc = (
            duration**-k * (way[k] * across + 16 * rise[k] * up) for k in range(3)
        )  # of the time since lift-off
        return self.start + pos, vel, acc


def center_of_pressure(point: Array, xy: Array, yaw: Array, corners: Array) -> Array:
    """The points (N, 2) of soles at `xy` (N, 2), `yaw` (N,) nearest to others: where their force acts."""
    rot = yaw_matrix(yaw)[:, :2, :2]
    inside = np.clip(rotate_back(rot, point - xy), corners[:, :2].min(axis=0), corners[:, :2].max(axis=0))
    return xy + rotate(rot, inside)


def plan_foothold(
    s: IKConfig, stance: Stance, side: Sides, capture: Array, rate: Array, left: Array, corners: Array
) -> tuple[Array, Array]:
    """Where feet are to land, from the capture points now.

    The capture point runs away from the other sole's pressure p as xi = p + (xi_0 - p) exp(omega t).

    Args:
        s: Reach of a step.
        stance: Where the feet stand or stood.
        side: (N,) which feet.
        capture: (N, 2) [m].
        rate: (N,) [1/s] omega.
        left: (N,) [s] until landing.
        corners: (C, 3) [m] of a sole.

    Returns:
        Places (N, 2) [m] in the anchor frame, and (N,) [m] how far the best place is from what a leg reaches.
    """
    rows = np.arange(len(side))
    xy, yaw = stance.xy[rows, 1 - side], stance.yaw[rows, 1 - side]
    p = center_of_pressure(capture, xy, yaw, corners)
    rot = yaw_matrix(yaw)[:, :2, :2]
    # seen from the standing sole
    ahead = rotate_back(rot, p + (capture - p) * np.exp(rate * left)[:, None] - xy)
    middle = 0.5 * (corners[:, 0].min() + corners[:, 0].max())
    x = ahead[:, 0] - middle
    y = OUTWARD[side] * ahead[:, 1] + s.step_beside
    reach_x = np.clip(x, -s.step_length, s.step_length)
    reach_y = np.clip(y, s.step_width[0], s.step_width[1])
    # a foot further out than needed is no miss: the capture point is then between the feet
    miss = np.abs(x - reach_x) + np.maximum(0.0, y - reach_y)
    return xy + rotate(rot, np.stack([reach_x, OUTWARD[side] * reach_y], axis=1)), miss


def choose_swing_foot(s: IKConfig, stance: Stance, capture: Array, rate: Array, corners: Array) -> Sides:
    """The feet (N,) to step with: whose landing misses least, then which have less far to go."""
    cost, left = [], np.full(len(rate), s.step_duration)
    for side in (0, 1):
        which = np.full(len(rate), side)
        xy, miss = plan_foothold(s, stance, which, capture, rate, left, corners)
        cost.append(MISS * miss + norm(xy - stance.xy[:, side]))
    return (cost[1] < cost[0]).astype(np.int64)


def solve_leg(kinematics: Kinematics, joints: Array, side: Sides, pos_b: Array, rot_b: Array) -> Array:
    """Leg joints (N, 4) [rad] near those of `joints` (N, 14) that put soles at poses, their toes at a pitch.

    Damped Gauss-Newton; without an ankle roll the sole's roll and yaw follow.
    """
    rows, leg, sole = np.arange(len(side)), LEGS[side], np.array(SOLES)[side]
    rows_of_leg = rows[:, None]
    trial = joints.copy()
    for _ in range(4):
        bodies = kinematics.at(trial)
        rot = bodies.rot[rows, sole]
        ankle = rot[..., 1]
        pitch = dot(ankle, rotate(rot, log3(transposed(rot) @ rot_b)))
        error = np.concatenate([pos_b - bodies.pos[rows, sole], pitch[:, None]], axis=1)
        pitching = bodies.axis[rows_of_leg, leg] @ ankle[..., None]
        jacobian = np.concatenate([bodies.linear[rows_of_leg, leg], pitching], axis=2)  # (N, 4, 4) transposed
        trial[rows_of_leg, leg] += damped_step(jacobian, error, LEG_DAMPING)
    return trial[rows_of_leg, leg]
