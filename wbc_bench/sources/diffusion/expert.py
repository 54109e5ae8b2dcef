"""The scripted expert that demonstrates: approach, push along the door's arc, retreat."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot import Scene
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources.diffusion.scene import STANDOFF, Door, DoorScene
from wbc_bench.sources.interface import Seen, StampedTarget
from wbc_bench.sources.paths import MINIMUM_JERK_PEAK, Path, Rest, line, minimum_jerk
from wbc_bench.sources.slew import Limits, Pose

Array = NDArray[np.float64]
LIMITS = Limits(0.20, 0.6)  # [m/s], [rad/s]; choice: below what `ik` follows
PUSH_SPEED = 0.35  # [rad/s] of the door
PRESS = 0.015  # [m] behind the panel that the hand is sent to, so that it presses
BEYOND = 0.06  # [rad] past the closed door
PRESSED = 0.6  # [s] of pressing the closed door
RETREAT = 0.12  # [m]


class Arc(NamedTuple):
    """The hand turns with the panel from the opening angle to beyond the closed door."""

    door: Door
    duration: float  # [s]

    def pose(self, time: float) -> Pose:
        """See `paths.Piece`."""
        part = minimum_jerk(time / self.duration)
        return self.door.hand(self.door.angle - part * (self.door.angle + BEYOND), -PRESS)


class ExpertSource:
    """Knows where the door stands; what the door does, it does not look at."""

    live = False

    def __init__(self, door: Door) -> None:
        self.name, self.door = "door-expert", door
        self.digest: str | None = None
        self.scene: Scene = DoorScene(door)
        self.counters: Mapping[str, int] = {}

    def look(self, scenery: Array) -> None:
        """The plan is made beforehand."""

    def reset(self, seen: Seen) -> None:
        """Lay the path from where the hand is."""
        door = self.door
        arc = Arc(door, MINIMUM_JERK_PEAK * (door.angle + BEYOND) / PUSH_SPEED)
        start, before = Pose(seen.ee_pos_w, seen.ee_rot_w), door.hand(door.angle, STANDOFF)
        end = arc.pose(arc.duration)
        self.path = Path(
            [
                line(start, before, LIMITS),
                line(before, arc.pose(0.0), LIMITS),
                arc,
                Rest(end, PRESSED),
                line(end, door.hand(0.0, RETREAT), LIMITS),
            ]
        )

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The pose of the plan at `time` [s]; the last one after its end."""
        pos, rot = self.path.pose(time)
        return StampedTarget(time, "world", pos, wxyz_from_matrix(rot))

    def close(self) -> None:
        """Nothing to let go of."""
