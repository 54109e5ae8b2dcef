"""What every source of targets has in common.

A source is asked once a control step: time and what there is to be seen go in, a stamped 6-DoF target comes
out. A source that acts on more than the robot (a door) brings its scene along, see `SceneSource`.
"""

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError
from wbc_bench.robot import Scene
from wbc_bench.rotations import matrix_from_wxyz

Array = NDArray[np.float64]
Frame = Literal["world", "base", "arm_mount"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
UNIT_TOLERANCE = 1e-3  # of a quaternion's norm; single precision leaves 1e-7, four decimals leave 1e-4


class StampedTarget(NamedTuple):
    """An end-effector pose asked for."""

    time: float  # [s] when it was made, on the clock of its source
    frame: Frame  # world; base: as it is now; arm_mount: axes of the base, origin where the arm stands
    pos: Array  # (3,) [m]
    quat_wxyz: Array  # (4,) unit, scalar first


class Seen(NamedTuple):
    """The one robot that a source drives, as a bystander sees it."""

    ee_pos_w: Array  # (3,) [m]
    ee_rot_w: Array  # (3, 3)
    base_pos_w: Array  # (3,) [m]
    base_rot_w: Array  # (3, 3)
    arm_mount_b: Array  # (3,) [m] where the arm stands on the base


class Source(Protocol):
    """Scripted, stream, live or learned."""

    name: str
    live: bool  # its targets come in real time, so the simulation must keep to it

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages by what became of them, `accepted` among others; empty where nothing comes in."""
        ...

    def reset(self, seen: Seen) -> None:
        """A new episode begins; the first target is best where the hand is."""
        ...

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The target at `time` [s] of the episode, which never goes back; never NaN."""
        ...

    def close(self) -> None:
        """Let go of sockets and threads."""
        ...


@runtime_checkable
class SceneSource(Source, Protocol):
    """A source whose targets only make sense in a scene of its own."""

    scene: Scene
    digest: str | None  # SHA-256 of what decides the targets; None where that is code alone

    def look(self, scenery: Array) -> None:
        """Positions (K,) of the joints that the scene added, before `reset` and before every `target`."""
        ...


def frame_pose(frame: Frame, seen: Seen) -> tuple[Array, Array]:
    """Origin (3,) [m] and axes (3, 3) of a frame in the world."""
    if frame == "world":
        return np.zeros(3), np.eye(3)
    offset = seen.arm_mount_b if frame == "arm_mount" else np.zeros(3)
    return seen.base_pos_w + seen.base_rot_w @ offset, seen.base_rot_w


def to_world(target: StampedTarget, seen: Seen) -> tuple[Array, Array]:
    """Pose (3,), (3, 3) of a target in the world."""
    origin_w, axes_w = frame_pose(target.frame, seen)
    return origin_w + axes_w @ target.pos, axes_w @ matrix_from_wxyz(target.quat_wxyz)


def from_world(pos_w: Array, rot_w: Array, frame: Frame, seen: Seen) -> tuple[Array, Array]:
    """Pose (3,), (3, 3) in a frame of a pose in the world."""
    origin_w, axes_w = frame_pose(frame, seen)
    return axes_w.T @ (pos_w - origin_w), axes_w.T @ rot_w


def unit(quat_wxyz: Array) -> Array:
    """A quaternion (4,) that is nearly unit, exactly so.

    Raises: SourceError when it is not even nearly.
    """
    norm = math.hypot(*quat_wxyz)  # does not overflow
    if not abs(norm - 1.0) <= UNIT_TOLERANCE:  # so written that NaN is refused
        valid = f"valid: 1 within {UNIT_TOLERANCE:g}"
        raise SourceError(f"quaternion {np.asarray(quat_wxyz).tolist()} has norm {norm:.4g}, {valid}")
    return quat_wxyz / norm
