"""Paths of a pose over time: pieces that each begin and end at rest, laid end to end."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from wbc_bench.rotations import geodesic_angle, matrix_from_rotvec, rotvec_from_matrix
from wbc_bench.sources.slew import Limits, Pose

Array = NDArray[np.float64]
MINIMUM_JERK_PEAK = 15 / 8  # largest slope of `minimum_jerk`, at the middle
RAMP = 1.0  # [s] of a lap from rest to full speed
MAX_CYCLES = 10  # of an axis in a lap
SAMPLES = 1440  # of a lap, on which its largest speed is found: a quarter of a degree
BETWEEN = 1.001  # cos(MAX_CYCLES * 0.125 deg) leaves 2.4e-4 between two samples


class Piece(Protocol):
    """A part of a path."""

    @property
    def duration(self) -> float:
        """[s]"""
        ...

    def pose(self, time: float) -> Pose:
        """The pose at `time` [s] since the piece began, 0 <= time <= duration."""
        ...


def minimum_jerk(s: float) -> float:
    """Smooth step from 0 to 1, at rest at both ends. Source: Flash & Hogan 1985, eq. 1."""
    return s**3 * (10 - 15 * s + 6 * s**2)


class Line(NamedTuple):
    """Straight line and geodesic between two poses, both with the minimum-jerk time law."""

    start: Pose
    end: Pose
    duration: float  # [s]

    def pose(self, time: float) -> Pose:
        """See `Piece`."""
        part = minimum_jerk(time / self.duration) if self.duration > 0 else 1.0
        turn = rotvec_from_matrix(self.start.rot.T @ self.end.rot)
        return Pose(
            self.start.pos + part * (self.end.pos - self.start.pos),
            self.start.rot @ matrix_from_rotvec(part * turn),
        )


def line(start: Pose, end: Pose, limits: Limits) -> Line:
    """The quickest line that keeps to both speed limits."""
    way = float(np.linalg.norm(end.pos - start.pos))
    turn = float(geodesic_angle(start.rot, end.rot))
    return Line(start, end, MINIMUM_JERK_PEAK * max(way / limits.linear, turn / limits.angular))


class Rest(NamedTuple):
    """Stay."""

    where: Pose
    duration: float  # [s]

    def pose(self, time: float) -> Pose:
        """See `Piece`."""
        return self.where


class Laps(NamedTuple):
    """Closed curve centre + amplitude * sin(cycles * phase), each axis its own; the orientation stays.

    The phase runs at a constant rate between two ramps, so the curve's speed never exceeds
    rate * max |d curve / d phase|.
    """

    centre: Pose
    amplitude: Array  # (3,) [m]
    cycles: Array  # (3,) whole periods of each axis in a lap
    rate: float  # [rad/s] of the phase
    ramp: float  # [s]
    duration: float  # [s] at least two ramps

    def phase(self, time: float) -> float:
        """[rad] of a trapezoidal speed: up in `ramp`, constant, down in `ramp`."""
        up = min(time, self.ramp)
        down = max(time - (self.duration - self.ramp), 0.0)
        level = time - up - down
        return self.rate * (up**2 / (2 * self.ramp) + level + down - down**2 / (2 * self.ramp))

    def pose(self, time: float) -> Pose:
        """See `Piece`."""
        return Pose(
            self.centre.pos + self.amplitude * np.sin(self.cycles * self.phase(time)), self.centre.rot
        )


def laps(centre: Pose, amplitude: Array, cycles: Array, count: int, limits: Limits) -> Laps:
    """`count` laps at the speed limit, gentle at both ends."""
    phase = np.linspace(0, 2 * np.pi, SAMPLES + 1)[:, None]
    slope = BETWEEN * np.linalg.norm(amplitude * cycles * np.cos(cycles * phase), axis=1).max()  # [m/rad]
    rate = limits.linear / float(slope)
    at_speed = 2 * np.pi * count / rate  # [s]; the two ramps cover half of what they would at full speed
    ramp = min(RAMP, at_speed)
    return Laps(centre, amplitude, cycles, rate, ramp, at_speed + ramp)


class Path:
    """Pieces end to end; the last pose is held."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self.pieces = tuple(pieces)
        self._starts = np.concatenate([[0.0], np.cumsum([piece.duration for piece in pieces])])

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self._starts[-1])

    def pose(self, time: float) -> Pose:
        """The pose at `time` [s]."""
        k = int(np.searchsorted(self._starts, time, side="right")) - 1
        k = min(max(k, 0), len(self.pieces) - 1)
        return self.pieces[k].pose(min(time - float(self._starts[k]), self.pieces[k].duration))
