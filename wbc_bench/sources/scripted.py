"""Targets from a file: waypoints, laps of a curve, or strokes over a board, with speed limits."""

import itertools
import math
from collections.abc import Mapping
from pathlib import Path as File
from typing import Annotated, NoReturn

import msgspec
import numpy as np

from wbc_bench.errors import SourceError
from wbc_bench.readers import read_toml
from wbc_bench.rotations import matrix_from_rpy, wxyz_from_matrix
from wbc_bench.schema import meaning_digest
from wbc_bench.sources.interface import Frame, Seen, StampedTarget, from_world
from wbc_bench.sources.paths import MAX_CYCLES, Path, Piece, Rest, laps, line
from wbc_bench.sources.slew import Limits, Pose

Vec3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
MAX_REPEATS = 1000  # loops, laps or strokes of a script
MAX_POSES = 10_000  # of a script, all loops counted: each is laid out before the episode begins
LARGEST = 1e6  # size of a number of a script [m], [rad], [s]: beyond it durations drown in rounding
Count = Annotated[int, msgspec.Meta(ge=1, le=MAX_REPEATS)]
Cycles = Annotated[int, msgspec.Meta(ge=0, le=MAX_CYCLES)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Speed(_Table, frozen=True):
    """Speed limits of the target, never exceeded."""

    linear: Positive  # [m/s]
    angular: Positive  # [rad/s]


class Waypoint(_Table, frozen=True):
    """A pose and how long to stay there."""

    pos: Vec3  # [m]
    rpy: Vec3 = (0.0, 0.0, 0.0)  # [rad] roll, pitch, yaw as in URDF
    dwell: NonNegative = 0.0  # [s]

    @property
    def pose(self) -> Pose:
        """As a matrix."""
        return Pose(np.array(self.pos), matrix_from_rpy(np.array(self.rpy)))


class Waypoints(_Table, frozen=True, tag="waypoints"):
    """Straight lines between poses, from the first to the last, `loops` times."""

    points: Annotated[tuple[Waypoint, ...], msgspec.Meta(min_length=1, max_length=MAX_POSES)]
    loops: Count = 1

    def pieces(self, limits: Limits) -> list[Piece]:
        """The path from the first pose on."""
        pieces: list[Piece] = []
        points = self.points * self.loops
        for k, point in enumerate(points):
            if k:
                pieces.append(line(points[k - 1].pose, point.pose, limits))
            pieces.append(Rest(point.pose, point.dwell))
        return pieces


class Curve(_Table, frozen=True, tag="curve"):
    """Laps of centre + amplitude * sin(cycles * phase): cycles 1 and 2 on two axes make a figure of eight."""

    centre: Vec3  # [m]
    amplitude: Vec3  # [m]
    cycles: tuple[Cycles, Cycles, Cycles]
    rpy: Vec3 = (0.0, 0.0, 0.0)  # [rad]
    laps: Count = 1

    def pieces(self, limits: Limits) -> list[Piece]:
        """The path from the centre on."""
        centre = Pose(np.array(self.centre), matrix_from_rpy(np.array(self.rpy)))
        return [laps(centre, np.array(self.amplitude), np.array(self.cycles), self.laps, limits)]


class Board(_Table, frozen=True, tag="board"):
    """Strokes to and fro over a rectangle that the hand points into: its y is along a stroke, its z up."""

    centre: Vec3  # [m]
    width: Positive  # [m] of a stroke
    height: Positive  # [m] from the first stroke to the last
    strokes: Annotated[int, msgspec.Meta(ge=2, le=MAX_REPEATS)]
    rpy: Vec3 = (0.0, 0.0, 0.0)  # [rad] of the hand

    def pieces(self, limits: Limits) -> list[Piece]:
        """The path from the upper left corner on."""
        rot = matrix_from_rpy(np.array(self.rpy))
        poses = []
        for k, z in enumerate(np.linspace(0.5, -0.5, self.strokes) * self.height):
            for side in (0.5, -0.5) if k % 2 == 0 else (-0.5, 0.5):
                poses.append(Pose(np.array(self.centre) + rot @ [0.0, side * self.width, z], rot))
        return [line(a, b, limits) for a, b in itertools.pairwise(poses)]


class Script(_Table, frozen=True):
    """A whole file."""

    name: str
    description: str
    limits: Speed
    path: Waypoints | Curve | Board
    frame: Frame = "world"

    @property
    def digest(self) -> str:
        """SHA-256 over the canonical JSON of every field but the description."""
        return meaning_digest(self)


def load_script(path: File) -> Script:
    """The script of a TOML file.

    Raises:
        SourceError: unreadable, an unknown key, a wrong type or an impossible number; names the field.
    """
    script = read_toml(path, Script, "source", SourceError)
    _check(script, path)
    return script


def _check(script: Script, path: File) -> None:
    """What a type cannot say: numbers of a sensible size, not too many poses, and something that moves."""

    def refuse(problem: str, where: str) -> NoReturn:
        raise SourceError(f"source {path}: {problem} - at `${where}`")

    if not any(c.isascii() and c.isalnum() for c in script.name):
        refuse(f"'{script.name}' cannot name a record, valid: at least one ASCII letter or digit", ".name")

    def walk(value: object, where: str) -> None:
        if isinstance(value, msgspec.Struct):
            for field in value.__struct_fields__:
                walk(getattr(value, field), f"{where}.{field}")
        elif isinstance(value, tuple):
            for k, item in enumerate(value):
                walk(item, f"{where}[{k}]")
        elif isinstance(value, float) and not math.isfinite(value):
            refuse(f"{value} is not a finite number", where)
        elif isinstance(value, float) and abs(value) > LARGEST:
            refuse(f"{value:g}, valid: {-LARGEST:g} to {LARGEST:g}", where)

    walk(script, "")
    curve = script.path
    if isinstance(curve, Waypoints):
        poses = len(curve.points) * curve.loops
        if poses > MAX_POSES:
            asked = f"{len(curve.points)} points in {curve.loops} loops are {poses} poses"
            refuse(f"{asked}, valid: at most {MAX_POSES}", ".path.loops")
    if isinstance(curve, Curve) and not np.multiply(curve.amplitude, curve.cycles).any():
        refuse("no axis has both an amplitude and cycles, so nothing moves", ".path.amplitude")


class ScriptedSource:
    """Plays a script; a line leads from where the hand is to where the script begins."""

    live = False

    def __init__(self, script: Script) -> None:
        self.name, self.script = script.name, script
        self.counters: Mapping[str, int] = {}
        self._limits = Limits(script.limits.linear, script.limits.angular)

    def reset(self, seen: Seen) -> None:
        """Lay the path, in the frame of the script."""
        hand = Pose(*from_world(seen.ee_pos_w, seen.ee_rot_w, self.script.frame, seen))
        pieces = self.script.path.pieces(self._limits)
        self.path = Path([line(hand, pieces[0].pose(0.0), self._limits), *pieces])

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The pose of the script at `time` [s]; the last one after its end."""
        pose = self.path.pose(time)
        return StampedTarget(time, self.script.frame, pose.pos, wxyz_from_matrix(pose.rot))

    def close(self) -> None:
        """Nothing to let go of."""
