"""What the controller asks of a solver of the whole-body program: one step for many episodes."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import Pose
from wbc_baselines.ik.kinematics import Configuration
from wbc_baselines.ik.model import Pose as OnePose
from wbc_baselines.ik.model import configuration
from wbc_baselines.ik.rows import Mask
from wbc_baselines.ik.stance import Hull, Stance
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_xyzw

Array = NDArray[np.float64]


class BatchIK(Protocol):
    """Stateless between steps, and no episode depends on the others of a call."""

    lanes: int  # episodes that a call takes at little more than the cost of one

    def step(
        self,
        q: Configuration,
        hand: Pose,
        stance: Stance,
        hull: Hull,
        posture: Array,
        posture_weight: Array,
        limit_speed: Mask,
    ) -> tuple[Configuration, Mask]:
        """The configurations one step on.

        Args:
            q: Where to start from.
            hand: Poses asked for, in the anchor frame as all else.
            stance: Soles asked for.
            hull: Support polygons.
            posture: (N, 14) [rad] joint positions preferred,
            posture_weight: (N,) and how much.
            limit_speed: (N,) whether joints keep their speed limits.

        Returns:
            The configurations, and a mask (N,) of the programs that have a solution; others are as they were.
        """
        ...


class OneIK(Protocol):
    """A solver of one episode: see `placo_ik`, `osqp_ik`."""

    def step(
        self,
        q: Array,
        ee: OnePose,
        soles: list[OnePose],
        hull: Array,
        posture: Array,
        posture_weight: float,
        limit_speed: bool = True,
    ) -> Array | None:
        """The configuration (21,) one step on, or None when the program has no solution."""
        ...


class OneByOne:
    """A solver of one episode, asked for each in turn."""

    lanes = 1

    def __init__(self, solver: OneIK) -> None:
        self._solver = solver

    def step(
        self,
        q: Configuration,
        hand: Pose,
        stance: Stance,
        hull: Hull,
        posture: Array,
        posture_weight: Array,
        limit_speed: Mask,
    ) -> tuple[Configuration, Mask]:
        """See `BatchIK.step`."""
        soles, turned = stance.pos(), stance.rot()
        found = np.zeros(len(posture), dtype=bool)
        q = q.take(np.arange(len(posture)))
        for i in range(len(posture)):
            step = self._solver.step(
                configuration(q.base.pos[i], q.base.rot[i], q.joints[i]),
                (hand.pos[i], hand.rot[i]),
                list(zip(soles[i], turned[i], strict=True)),
                hull.corners(i),
                posture[i],
                float(posture_weight[i]),
                limit_speed=bool(limit_speed[i]),
            )
            if step is not None:
                found[i] = True
                q.base.pos[i], q.joints[i] = step[:3], step[7:]
                q.base.rot[i] = matrix_from_wxyz(wxyz_from_xyzw(step[3:7]))
        return q, found
