"""A target that a person sets from inside this process, e.g. by dragging it in the viewer."""

import threading
from collections.abc import Mapping

import numpy as np

from wbc_bench.errors import SourceError
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_matrix
from wbc_bench.sources.interface import FRAMES, Seen, StampedTarget, from_world, to_world, unit
from wbc_bench.sources.slew import Limits, Pose, slew

LIVE = "live"


class LiveSource:
    """The latest target wins; the robot is led there no faster than the limits. Safe between threads."""

    live = True

    def __init__(self, limits: Limits = Limits()) -> None:  # noqa: B008  (immutable)
        self.name = LIVE
        self.counters: Mapping[str, int] = {}
        self._limits = limits
        self._lock = threading.Lock()
        self._latest: StampedTarget | None = None

    def set_target(self, target: StampedTarget) -> None:
        """From any thread; `reset` forgets what was set before it.

        Raises: SourceError when the target is not finite, not a unit quaternion, or in no known frame.
        """
        pos, quat = np.array(target.pos, dtype=float), np.array(target.quat_wxyz, dtype=float)
        if target.frame not in FRAMES:
            raise SourceError(f"target frame '{target.frame}', valid: {', '.join(FRAMES)}")
        if pos.shape != (3,) or quat.shape != (4,) or not np.isfinite(pos).all():
            raise SourceError(f"target {pos.tolist()} {quat.tolist()}, valid: 3 and 4 finite numbers")
        checked = target._replace(
            pos=pos, quat_wxyz=unit(quat)
        )  # copies: the caller may go on writing to his
        with self._lock:
            self._latest = checked

    def reset(self, seen: Seen) -> None:
        """Begin where the hand is."""
        with self._lock:
            self._latest = None
        self._time, self._now_w = 0.0, Pose(seen.ee_pos_w, seen.ee_rot_w)

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """On the way to the latest target."""
        with self._lock:
            latest = self._latest
        frame = "world" if latest is None else latest.frame
        now = Pose(*from_world(*self._now_w, frame, seen))
        if latest is not None:
            goal = Pose(latest.pos, matrix_from_wxyz(latest.quat_wxyz))
            now = slew(now, goal, time - self._time, self._limits)
        target = StampedTarget(time, frame, now.pos, wxyz_from_matrix(now.rot))
        self._time, self._now_w = time, Pose(*to_world(target, seen))
        return target

    def close(self) -> None:
        """Nothing to let go of."""
