"""The way of the hand: from where it is to the target, slowly and smoothly, towards a planned posture."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.model import Pose, WholeBodyModel, turn

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


class Reference:
    """Slewed target of one episode in the anchor frame, and the joint posture that goes with it."""

    def __init__(self, config: IKConfig, period: float, ee: Pose, target: Pose, posture: Array) -> None:
        self._s, self._period = config, period
        self.ee = ee  # where the hand should be now
        self.target = target  # filtered
        self.posture = posture  # (14,) [rad] preferred now
        self.goal: Array | None = None  # (14,) [rad] planned at the target
        self._start = posture
        self._speed = 0.0  # fraction of the limit
        self._way, self.left = 0.0, np.inf  # [s] at full speed: the longest seen, and what is left

    def track(self, target: Pose) -> None:
        """Take in a measured target."""
        part = self._period / self._s.target_filter
        self.target = (
            self.target[0] + part * (target[0] - self.target[0]),
            turn(self.target[1], target[1], part),
        )

    def set_goal(self, start: Array, goal: Array) -> None:
        """The posture (14,) moves from one configuration to another as the hand goes its way."""
        self._start, self.goal = start, goal

    def advance(self) -> None:
        """One step of the way."""
        s = self._s
        way, turning = self.target[0] - self.ee[0], pin.log3(self.ee[1].T @ self.target[1])
        self.left = max(norm(way) / s.slew_linear, norm(turning) / s.slew_angular)
        self._way = max(self._way, self.left)
        self._speed = min(1.0, self._speed + self._period / s.slew_ramp, s.slew_gain * self.left)
        part = min(1.0, self._speed * self._period / max(self.left, 1e-9))
        self.ee = (self.ee[0] + part * way, self.ee[1] @ pin.exp3(part * turning))
        if self.goal is not None:
            self.posture = self.goal + (self.left / max(self._way, 1e-9)) * (self._start - self.goal)


def plan_goal_posture(
    solver,
    model: WholeBodyModel,
    q: Array,
    ee: Pose,
    target: Pose,
    soles: list[Pose],
    hull: Array,
    default: Array,
    weight: float,
) -> tuple[Array, float]:
    """Joint positions (14,) at the target, and the error [m + 0.3 m/rad] left there.

    Differential IK falls into local minima: it is run from several preferred postures, and the first that
    arrives within 1 cm, or the best, is taken.
    """
    best, best_error = q, np.inf
    turning = pin.log3(ee[1].T @ target[1])
    for seed in seeds(default):
        trial = q
        for k in range(60):
            part = min(1.0, (k + 1) / 35)
            pose = (ee[0] + part * (target[0] - ee[0]), ee[1] @ pin.exp3(part * turning))
            step = solver.step(trial, pose, soles, hull, seed, weight, limit_speed=False)
            if step is None:
                break
            trial = step
        pos, rot = model.ee_of(trial)
        error = norm(pos - target[0]) + 0.3 * norm(pin.log3(rot.T @ target[1]))
        # a base that leans this far is about to be counted as fallen
        error += max(0.0, float(np.arccos(np.clip(upright(trial), -1.0, 1.0))) - MAX_LEAN)
        if error < best_error:
            best, best_error = trial, error
        if error < 0.01:
            break
    return best[7:], best_error


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


def upright(q: Array) -> float:
    """Cosine of the angle between the base's and the world's vertical at a configuration (21,)."""
    x, y = q[3], q[4]
    return 1.0 - 2.0 * (x * x + y * y)


def norm(vector: Array) -> float:
    """Euclidean length."""
    return float(np.sqrt(vector @ vector))
