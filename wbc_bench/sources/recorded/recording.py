"""A recorded trajectory of an end effector, and the source that plays it."""

import hashlib
from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources.adapters import EE_FROM_UMI_TCP
from wbc_bench.sources.interface import Frame, Seen, StampedTarget, from_world
from wbc_bench.sources.paths import Path, line
from wbc_bench.sources.slew import Limits, Pose, between

Array = NDArray[np.float64]
MAX_ROWS = 1_000_000  # of a file: 80 min at 200 Hz
LARGEST = 1e3  # size of a coordinate [m], as of a demonstration; choice
Tool = Literal["ee", "umi"]
TOOLS: tuple[Tool, ...] = get_args(Tool)
Place = Literal["world", "base", "arm_mount", "start"]
PLACES: tuple[Place, ...] = get_args(Place)


class Facts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What poses mean; the user names it, or the file does."""

    rate: Annotated[float, msgspec.Meta(ge=0.1, le=10_000)] | None = None  # [Hz]
    frame: Place | None = None
    tool: Tool | None = None

    def over(self, other: "Facts") -> "Facts":
        """These, and those of `other` where these are silent."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__struct_fields__)
        return Facts(*[other if own is None else own for own, other in pairs])


class Poses(NamedTuple):
    """One episode of a file, in its own words."""

    pos: Array  # (T, 3) [m]
    rot: Array  # (T, 3, 3)
    time: Array | None  # (T,) [s], None where the file has none
    facts: Facts  # as far as the file, or its format, names them
    content: str  # SHA-256 of what was read


class Recording(NamedTuple):
    """One episode, ready to be played."""

    name: str
    time: Array  # (T,) [s] from 0
    pos: Array  # (T, 3) [m] of the hand
    rot: Array  # (T, 3, 3) of the hand: x forward, z up
    frame: Place
    digest: str  # SHA-256 of what decides the targets

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.time[-1])

    def pose(self, time: float) -> Pose:
        """The pose at `time` [s], on straight lines and geodesics between rows."""
        k = int(np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1))
        here = Pose(self.pos[k], self.rot[k])
        if k == len(self.time) - 1:
            return here
        part = (time - self.time[k]) / (self.time[k + 1] - self.time[k])
        return between(here, Pose(self.pos[k + 1], self.rot[k + 1]), float(part))


def recording_of(name: str, where: str, found: Poses, given: Facts, episode: int) -> Recording:
    """A recording of the poses of a file and of what the user says of them.

    Args:
        name: Of the source.
        where: The file, for errors.
        found: What was read.
        given: What the user says, which counts where the file says otherwise.
        episode: Which one of the file, for the digest.

    Raises:
        SourceError: a fact that neither names, a rate beside a time column, no rows or too many, times that
            do not rise, numbers that are none or too large.
    """
    facts = given.over(found.facts)
    if found.time is not None:
        if given.rate is not None:
            raise SourceError(f"{where} has a time column, valid: no rate beside it, given {given.rate:g} Hz")
        facts = msgspec.structs.replace(facts, rate=None)
    needed = ("frame", "tool") if found.time is not None else ("rate", "frame", "tool")
    missing = [fact for fact in needed if getattr(facts, fact) is None]
    if missing:
        examples = {"rate": "rate=50", "frame": "frame=world", "tool": "tool=ee"}
        example = "&".join(examples[fact] for fact in missing)
        raise SourceError(
            f"{where} does not name {', '.join(missing)}: append e.g. '?{example}' to --source; valid: rate "
            f"in Hz; frame {', '.join(PLACES)}; tool {', '.join(TOOLS)}"
        )
    rows = len(found.pos)
    if not 1 <= rows <= MAX_ROWS:
        raise SourceError(f"{where} has {rows} poses, valid: 1 to {MAX_ROWS}")
    if not (np.abs(found.pos) <= LARGEST).all() or not np.isfinite(found.rot).all():
        raise SourceError(f"{where} holds a number that is not finite or beyond {LARGEST:g} m")
    time = found.time
    if time is None:
        assert facts.rate is not None
        time = np.arange(rows) / facts.rate
    if not (np.isfinite(time).all() and (np.diff(time) > 0).all() and np.isfinite(time[-1] - time[0])):
        raise SourceError(f"{where} has times that are not finite or do not rise")
    assert facts.frame is not None
    rot = found.rot @ EE_FROM_UMI_TCP.T if facts.tool == "umi" else found.rot
    said = msgspec.json.encode([found.content, facts, episode])
    digest = hashlib.sha256(said).hexdigest()
    return Recording(name, time - time[0], found.pos, rot, facts.frame, digest)


class RecordedSource:
    """Plays a recording at its own pace; a line leads from where the hand is to its first pose."""

    live = False

    def __init__(self, recording: Recording) -> None:
        self.name, self.recording = recording.name, recording
        self.digest = recording.digest
        self.counters: Mapping[str, int] = {}

    def reset(self, seen: Seen) -> None:
        """Lay the path, in the frame of the recording."""
        recording = self.recording
        self.frame: Frame = "world" if recording.frame == "start" else recording.frame
        hand = Pose(*from_world(seen.ee_pos_w, seen.ee_rot_w, self.frame, seen))
        if recording.frame == "start":
            recording = moved_to(hand, recording)
        self.path = Path([line(hand, recording.pose(0.0), Limits()), recording])

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The pose at `time` [s]; the last one after the end."""
        pose = self.path.pose(time)
        return StampedTarget(time, self.frame, pose.pos, wxyz_from_matrix(pose.rot))

    def close(self) -> None:
        """Nothing to let go of."""


def moved_to(hand: Pose, recording: Recording) -> Recording:
    """A recording shifted so that it begins at the hand, and turned about the vertical as near to its axes.

    Roll and pitch stay, so that what was level is level. The turn about z with the least angle left between
    two rotations maximises trace(hand^T Rz first): the planar part of Wahba's problem (1965).
    """
    relative = hand.rot @ recording.rot[0].T
    yaw = np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pos = hand.pos + (recording.pos - recording.pos[0]) @ turn.T
    return recording._replace(pos=pos, rot=turn @ recording.rot)
