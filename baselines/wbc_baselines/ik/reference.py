"""The way of the hand: from where it is to the target, slowly and smoothly, towards a planned posture."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.batch_ik import BatchIK
from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.geometry import Pose, log3, norm, transposed, turn
from wbc_baselines.ik.kinematics import Configuration, Kinematics
from wbc_baselines.ik.rows import Mask, Rows
from wbc_baselines.ik.stance import Hull, Stance
from wbc_bench.rotations import matrix_from_rotvec

Array = NDArray[np.float64]
# hip, knee, J1, J2, J3 [rad]: squatting, upright, leaning, crouching, arm to either side
SEEDS = (
    (0.6, 0.9, 0.0, 1.5, 1.5),
    (0.0, 0.0, 0.0, 1.5, 1.5),
    (-0.3, -0.5, 0.0, 1.2, 0.6),
    (0.9, 1.1, 0.0, 2.5, 0.8),
    (0.0, 0.0, 1.0, 1.5, 1.5),
    (0.0, 0.0, -1.0, 1.5, 1.5),
)

MAX_LEAN = 1.0  # [rad]
ARRIVED = 0.01  # [m + 0.3 m/rad]
STEPS, SLEW = 60, 35  # of a plan, and of them until the target has arrived


@dataclass
class Reference(Rows):
    """Slewed targets of N episodes in the anchor frame, and the joint postures that go with them."""

    hand: Pose  # where the hands should be now
    target: Pose  # filtered
    posture: Array  # (N, 14) [rad] preferred now
    start: Array  # (N, 14) [rad] where the posture began
    goal: Array  # (N, 14) [rad] planned at the target
    planned: Mask  # (N,) whether there is a goal
    speed: Array  # (N,) fraction of the limit
    way: Array  # (N,) [s] at full speed: the longest that was left,
    left: Array  # (N,) [s] and what is left

    @classmethod
    def begin(cls, hand: Pose, target: Pose, posture: Array) -> "Reference":
        """At rest, with the way still to be planned."""
        zero = np.zeros(len(posture))
        left = np.full(len(posture), np.inf)
        no_goal, none = np.zeros_like(posture), np.zeros(len(posture), dtype=bool)
        return cls(hand, target, posture.copy(), posture.copy(), no_goal, none, zero, zero.copy(), left)

    def track(self, s: IKConfig, period: float, target: Pose) -> None:
        """Take in measured targets."""
        part = period / s.target_filter
        pos = self.target.pos + part * (target.pos - self.target.pos)
        self.target = Pose(pos, turn(self.target.rot, target.rot, part))

    def set_goal(self, start: Array, goal: Array) -> None:
        """The postures (N, 14) move from one configuration to another as the hands go their way."""
        self.start, self.goal, self.planned = start, goal, np.ones(len(goal), dtype=bool)

    def advance(self, s: IKConfig, period: float) -> None:
        """One step of the way."""
        way = self.target.pos - self.hand.pos
        turning = log3(transposed(self.hand.rot) @ self.target.rot)
        self.left = np.maximum(norm(way) / s.slew_linear, norm(turning) / s.slew_angular)
        self.way = np.maximum(self.way, self.left)
        ramp = np.minimum(1.0, self.speed + period / s.slew_ramp)
        self.speed = np.minimum(ramp, s.slew_gain * self.left)
        part = np.minimum(1.0, self.speed * period / np.maximum(self.left, 1e-9))[:, None]
        rot = self.hand.rot @ matrix_from_rotvec(part * turning)
        self.hand = Pose(self.hand.pos + part * way, rot)
        ahead = (self.left / np.maximum(self.way, 1e-9))[:, None]
        posture = self.goal + ahead * (self.start - self.goal)
        self.posture = np.where(self.planned[:, None], posture, self.posture)


def plan_goal_posture(
    solver: BatchIK,
    kinematics: Kinematics,
    start: Configuration,
    hand: Pose,
    target: Pose,
    stance: Stance,
    hull: Hull,
    default: Array,
    weight: float,
) -> tuple[Array, Array]:
    """Joint positions (N, 14) at targets, and the errors (N,) [m + 0.3 m/rad] left there.

    Differential IK falls into local minima: it is run from several preferred postures, and the first that
    arrives within 1 cm, or the best, is taken. How many of them are run at once does not change the result.
    """
    postures = np.array(seeds(default))
    best, best_error = start.joints.copy(), np.full(len(start.joints), np.inf)
    open_rows, first = np.arange(len(best)), 0
    while len(open_rows) and first < len(postures):
        chosen = postures[first : first + max(1, solver.lanes // len(open_rows))]
        first += len(chosen)
        rows = np.repeat(open_rows, len(chosen))
        wanted = np.tile(chosen, (len(open_rows), 1))
        part = start.take(rows), hand.take(rows), target.take(rows), stance.take(rows), hull.take(rows)
        joints, error = _walk(solver, kinematics, *part, wanted, weight)
        error = error.reshape(len(open_rows), len(chosen))
        joints = joints.reshape(*error.shape, -1)
        arrived = error < ARRIVED
        pick = np.where(arrived.any(axis=1), arrived.argmax(axis=1), error.argmin(axis=1))
        each = np.arange(len(open_rows))
        joints, error = joints[each, pick], error[each, pick]
        better = error < best_error[open_rows]
        best[open_rows[better]], best_error[open_rows[better]] = joints[better], error[better]
        open_rows = open_rows[best_error[open_rows] >= ARRIVED]
    return best, best_error


def _walk(
    solver: BatchIK,
    kinematics: Kinematics,
    q: Configuration,
    hand: Pose,
    target: Pose,
    stance: Stance,
    hull: Hull,
    posture: Array,
    weight: float,
) -> tuple[Array, Array]:
    """Joint positions (N, 14) after 60 steps towards a preferred posture each, and the errors (N,) there."""
    turning = log3(transposed(hand.rot) @ target.rot)
    weights, free = np.full(len(posture), weight), np.zeros(len(posture), dtype=bool)
    going = ~free
    for k in range(STEPS):
        part = min(1.0, (k + 1) / SLEW)
        rot = hand.rot @ matrix_from_rotvec(part * turning)
        pose = Pose(hand.pos + part * (target.pos - hand.pos), rot)
        step, found = solver.step(q, pose, stance, hull, posture, weights, free)
        going &= found
        if not going.any():
            break
        q.put(going, step.take(going))
    reached = q.hand(kinematics.at(q.joints))
    error = norm(reached.pos - target.pos) + 0.3 * norm(log3(transposed(reached.rot) @ target.rot))
    # a base that leans this far is about to be counted as fallen
    lean = np.arccos(np.clip(q.base.rot[:, 2, 2], -1.0, 1.0))
    return q.joints, error + np.maximum(0.0, lean - MAX_LEAN)


def seeds(default: Array) -> list[Array]:
    """Postures (14,) [rad] to start from, the default first."""
    postures = [default]
    for hip, knee, j1, j2, j3 in SEEDS:
        q = default.copy()
        # left and right hips and knees turn about opposite axes, the ankles about the same
        q[[1, 2, 3, 5, 6, 7]] = hip, knee, knee - hip, -hip, -knee, knee - hip
        q[8:11] = j1, j2, j3
        postures.append(q)
    return postures
