"""What a tracked source leaves behind: time series, their scores, records on disk, and the table of them.

`<root>/tracks/<source>/<controller>/<condition>_<seed>/track.json`, series.parquet
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from wbc_bench.outcomes import TERMINATED
from wbc_bench.results.formatting import CM, DEG, NONE, names_note, number_text
from wbc_bench.results.metrics import spectral_arc_length
from wbc_bench.results.records import (
    driven_folder,
    not_finite,
    parquet_of,
    read_record,
    refuse_values,
    write_record,
)
from wbc_bench.results.table import Table
from wbc_bench.rotations import geodesic_angle

Array = NDArray[np.float64]
STOOD = "stood"  # the outcome of a run to its end; otherwise one of episodes.TERMINATED
MAX_LAG = 3.0  # [s] a longer one is not following
FOLLOWS = 0.5  # of the target's variance that the hand must repeat for its lag to mean anything; choice


@dataclass(frozen=True)
class Tracked:
    """T control steps of one episode: the target as it was handed over, and the hand at that moment."""

    control_period: float  # [s]
    outcome: str  # STOOD or one of episodes.TERMINATED
    target_pos_w: Array  # (T, 3) [m]
    ee_pos_w: Array  # (T, 3) [m]
    position_error: Array  # (T,) [m]
    orientation_error: Array  # (T,) [rad] geodesic

    @property
    def time(self) -> Array:
        """(T,) [s]"""
        return self.control_period * np.arange(len(self.position_error), dtype=np.float64)


class Series:
    """Collects a run step by step."""

    def __init__(self, control_period: float) -> None:
        self._period = control_period  # [s]
        self._target_pos_w: list[Array] = []
        self._ee_pos_w: list[Array] = []
        self._errors: list[tuple[float, float]] = []

    def add(self, target_pos_w: Array, target_rot_w: Array, ee_pos_w: Array, ee_rot_w: Array) -> None:
        """A target as it is handed over, and the hand at that moment: (3,) [m] and (3, 3) each."""
        self._target_pos_w.append(target_pos_w)
        self._ee_pos_w.append(ee_pos_w)
        error = float(np.linalg.norm(ee_pos_w - target_pos_w))
        self._errors.append((error, float(geodesic_angle(ee_rot_w, target_rot_w))))

    def tracked(self, outcome: str) -> Tracked:
        """What has been collected, of a run that ended so."""
        errors = np.reshape(np.array(self._errors, dtype=float), (-1, 2))
        return Tracked(
            control_period=self._period,
            outcome=outcome,
            target_pos_w=np.reshape(self._target_pos_w, (-1, 3)),
            ee_pos_w=np.reshape(self._ee_pos_w, (-1, 3)),
            position_error=errors[:, 0],
            orientation_error=errors[:, 1],
        )


class Scores(NamedTuple):
    """One number per run; errors over the steps completed, the rest NaN unless the robot stood to the end."""

    position_mean: float  # [m]
    position_p95: float  # [m]
    orientation_mean: float  # [rad]
    orientation_p95: float  # [rad]
    lag: float  # [s] NaN where the hand does not follow, or the target does not move
    residual: float  # [m] root mean square of the position error that is left after the lag; NaN likewise
    sparc: float  # [1] of the hand's speed; it depends on the duration
    target_sparc: float  # [1] of the target's speed, over the same steps


def lag(target: Array, hand: Array, period: float) -> tuple[float, float]:
    """The delay [s] that explains the hand (T, 3) best as the target (T, 3), and the RMS distance [m] then.

    The shift of the target, in whole steps, with the least root mean square distance. Source: Knapp & Carter
    1976, IEEE Trans. ASSP 24(4); the least-squares shift is that of the largest cross-correlation as far as
    the energy inside the window does not change with the shift.

    Returns: NaN, NaN when the best shift leaves more than 1 - FOLLOWS of the target's variance, or is the
    largest.
    """
    most = round(MAX_LAG / period)
    if len(target) < 2 * most:
        return np.nan, np.nan
    # the same instants of the hand at every shift, or a shift could win by dropping a hard part
    late = hand[most:]
    squares = np.array(
        [((late - target[most - k : len(target) - k]) ** 2).sum(axis=1).mean() for k in range(most + 1)]
    )  # (K,) [m^2]
    best = int(squares.argmin())
    asked = target[most - best : len(target) - best]
    variance = ((asked - asked.mean(axis=0)) ** 2).sum(axis=1).mean()  # [m^2]
    if best == most or not squares[best] < (1 - FOLLOWS) * variance:
        return np.nan, np.nan
    return best * period, float(np.sqrt(squares[best]))


def score(tracked: Tracked) -> Scores:
    """The scores of a run; NaN without a step."""
    position, orientation = tracked.position_error, tracked.orientation_error
    if len(position) == 0:
        return Scores(*[np.nan] * len(Scores._fields))
    delay = residual = sparc = target_sparc = np.nan
    if tracked.outcome == STOOD:  # the way to the ground neither follows nor is smooth
        target, hand, period = tracked.target_pos_w, tracked.ee_pos_w, tracked.control_period
        delay, residual = lag(target, hand, period)
        sparc, target_sparc = smoothness(hand, period), smoothness(target, period)
    return Scores(
        position_mean=float(position.mean()),
        position_p95=float(np.quantile(position, 0.95)),
        orientation_mean=float(orientation.mean()),
        orientation_p95=float(np.quantile(orientation, 0.95)),
        lag=delay,
        residual=residual,
        sparc=sparc,
        target_sparc=target_sparc,
    )


def smoothness(pos: Array, period: float) -> float:
    """Spectral arc length [1] of the speed along (T, 3) [m]; 0 is smoothest. Source: see `metrics`."""
    if len(pos) < 3:
        return np.nan
    speed = np.linalg.norm(np.diff(pos, axis=0), axis=1) / period  # [m/s]
    return float(spectral_arc_length(speed[None], 1.0 / period)[0])


# --- records --------------------------------------------------------------------------------------------


class TrackRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What was run, and where the series beside it come from."""

    source: str
    source_sha256: str | None  # of a script or a policy; a stream or a person has none
    controller: str  # the spec as it was given
    signals: list[str]
    condition: str
    seed: int
    requested_s: float  # [s]
    completed_s: float  # [s]
    outcome: str
    control_period: float  # [s]
    counters: dict[str, int]  # of messages, by what became of them
    series_sha256: str  # of series.parquet
    software_sha256: str
    git_commit: str | None
    git_dirty: bool
    versions: dict[str, str]
    machine: dict[str, str | int | float]
    created: str  # UTC, ISO 8601
    commands: list[str] = []  # parts of the controller's commands beside positions


class Track(NamedTuple):
    """A run on disk."""

    record: TrackRecord
    tracked: Tracked


def write_track(root: Path, tracked: Tracked, **facts) -> Path:
    """Write a run, replacing an earlier one of the same source, controller, condition and seed.

    Raises: StoreError when the folder cannot be written.
    """
    columns = {f"target_{axis}": tracked.target_pos_w[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"ee_{axis}": tracked.ee_pos_w[:, k] for k, axis in enumerate("xyz")}
    columns |= {
        "position_error": tracked.position_error,
        "orientation_error": tracked.orientation_error,
    }
    data, digest = parquet_of(pa.table(columns))
    record = TrackRecord(
        completed_s=round(len(tracked.position_error) * tracked.control_period, 9),
        outcome=tracked.outcome,
        control_period=tracked.control_period,
        series_sha256=digest,
        **facts,
    )
    folder = driven_folder(root, "tracks", record)
    write_record(folder / "track.json", record, folder / "series.parquet", data)
    return folder


def read_tracks(root: Path) -> list[Track]:
    """Every run under a folder, sorted by source, controller, condition and seed.

    Raises: StoreError when one cannot be read or its series are not those it was written with.
    """
    tracks = [_read(path) for path in root.glob("tracks/*/*/*/track.json")]
    return sorted(tracks, key=lambda track: _key(track.record))


def _key(record: TrackRecord) -> tuple[str, str, str, int]:
    return record.source, record.controller, record.condition, record.seed


def _read(path: Path) -> Track:
    beside = path.with_name("series.parquet")
    record, series = read_record(path, TrackRecord, beside, "series_sha256", SERIES)
    refuse_values(path, _mistakes(record, len(series)))
    frame = series.to_pandas()
    refuse_values(beside, not_finite(frame, SERIES))

    def columns(*names: str) -> Array:
        return frame[list(names)].to_numpy(dtype=float)

    tracked = Tracked(
        control_period=record.control_period,
        outcome=record.outcome,
        target_pos_w=columns("target_x", "target_y", "target_z"),
        ee_pos_w=columns("ee_x", "ee_y", "ee_z"),
        position_error=columns("position_error")[:, 0],
        orientation_error=columns("orientation_error")[:, 0],
    )
    return Track(record, tracked)


SERIES = dict.fromkeys(
    (
        *(f"{of}_{axis}" for of in ("target", "ee") for axis in "xyz"),
        *("position_error", "orientation_error"),
    ),
    "double",
)


def _mistakes(record: TrackRecord, steps: int) -> Iterator[tuple[str, object, str]]:
    """(field, value, what is valid) of what the series beside a record contradict."""
    outcomes = (STOOD, *map(str, TERMINATED))
    if record.outcome not in outcomes:
        yield "outcome", f"'{record.outcome}'", ", ".join(outcomes)
    if not 1e-4 <= record.control_period <= 1.0:
        yield "control_period", record.control_period, "0.0001 to 1 s"
    if abs(steps * record.control_period - record.completed_s) > 1e-6:
        yield "completed_s", record.completed_s, f"{steps} steps of {record.control_period:g} s"


# --- table ----------------------------------------------------------------------------------------------

COLUMNS = (  # header, score, scale, digits
    ("Pos. mean ↓ (cm)", "position_mean", CM, 2),
    ("Pos. P95 ↓ (cm)", "position_p95", CM, 2),
    ("Ori. mean ↓ (deg)", "orientation_mean", DEG, 2),
    ("Ori. P95 ↓ (deg)", "orientation_p95", DEG, 2),
    ("Lag ↓ (s)", "lag", 1.0, 2),
    ("Pos. after lag ↓ (cm)", "residual", CM, 2),
    ("SPARC ↑", "sparc", 1.0, 1),
    ("SPARC of target", "target_sparc", 1.0, 1),
)


def tracking_table(tracks: list[Track], labels: Mapping[str, str] | None = None) -> Table:
    """Controllers x sources; a row is the mean over the seeds of one condition.

    `labels` maps a spec to its name.
    """
    labels = labels or {}
    groups: dict[tuple[str, str, str], list[Track]] = {}
    for track in tracks:
        groups.setdefault(_key(track.record)[:3], []).append(track)
    rows, data, before = [], [], None
    for (source, controller, condition), same in groups.items():
        # undisturbed runs of several seeds are one run: equal series count once
        runs = list({run.record.series_sha256: run for run in same}.values())
        values = {name: _mean([getattr(score(run.tracked), name) for run in runs]) for name in Scores._fields}
        stood = sum(run.record.outcome == STOOD for run in runs)
        completed, requested = (
            sum(getattr(run.record, f"{what}_s") for run in runs) for what in ("completed", "requested")
        )
        cells = (number_text(values[name] * scale, digits) for _, name, scale, digits in COLUMNS)
        counts = f"{stood}/{len(runs)}", f"{completed:.1f}/{requested:.1f}"
        rows.append(
            (
                source if source != before else "",
                labels.get(controller, f"`{controller}`"),
                condition,
                *counts,
                *cells,
            )
        )
        before = source
        data.append(
            {"source": source, "controller": controller, "condition": condition, "runs": len(runs)}
            | {"stood": stood, "completed_s": completed, "requested_s": requested}
            | {f"{name}_avg": value for name, value in values.items()}
        )
    header = ("Source", "Controller", "Condition", "Stood", "Time (s)", *(column[0] for column in COLUMNS))
    notes = (
        "The same controller, unmodified, follows targets from any source. `Stood`: runs that ended standing "
        "of all; `Time`: completed of requested. Errors compare hand and target at the same instant, over "
        "the steps completed: those of a run that fell early do not compare.",
        f"Lag: the shift of the target, up to {MAX_LAG:g} s, with the least root mean square distance to the "
        f"hand (Knapp & Carter 1976), and what is left of that distance; {NONE} where the hand repeats less "
        f"than {FOLLOWS:.0%} of the target's variance.",
        "SPARC: spectral arc length of the speed over the whole run; 0 is smoothest, and it falls with the "
        "length of a run, so compare a hand with its target. Lag and SPARC are undefined after a fall.",
        *names_note({c: labels[c] for _, c, _ in groups if c in labels}),
    )
    return Table("tracking", "Tracking of moving targets", header, tuple(rows), notes, pd.DataFrame(data))


def _mean(values: list[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else np.nan
