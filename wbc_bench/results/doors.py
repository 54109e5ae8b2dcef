"""What pushing doors shut leaves behind: a row per episode, a record of the run, and the table of them.

`<root>/doors/<source>/<controller>/<condition>_<seed>/run.json`, episodes.parquet
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa

from wbc_bench.outcomes import TERMINATED
from wbc_bench.results import stats
from wbc_bench.results.formatting import DEG, names_note, number_text
from wbc_bench.results.records import (
    driven_folder,
    not_finite,
    parquet_of,
    read_record,
    refuse_values,
    write_record,
)
from wbc_bench.results.table import Table
from wbc_bench.results.tracking import STOOD


class DoorRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What was run, and where the episodes beside it come from."""

    source: str
    policy_sha256: str | None  # of the policy's file; the expert has none
    controller: str  # the spec as it was given
    signals: list[str]
    condition: str
    seed: int  # of the doors
    requested: int
    completed: int
    successes: int
    duration: float  # [s] of an episode
    closed_below: float  # [rad]
    episodes_sha256: str  # of episodes.parquet
    software_sha256: str
    git_commit: str | None
    git_dirty: bool
    versions: dict[str, str]
    machine: dict[str, str | int | float]
    created: str  # UTC, ISO 8601
    commands: list[str] = []  # parts of the controller's commands beside positions


class DoorRun(NamedTuple):
    """A run on disk."""

    record: DoorRecord
    episodes: pd.DataFrame


def write_doors(root: Path, episodes: pd.DataFrame, **facts) -> Path:
    """Write a run, replacing an earlier one of the same source, controller, condition and seed.

    Args: episodes with x, y, z [m], yaw, angle, final_angle [rad], first_closed [s], outcome, success, steps.

    Raises: StoreError when the folder cannot be written.
    """
    table = pa.Table.from_pandas(episodes, preserve_index=False).replace_schema_metadata()
    data, digest = parquet_of(table)
    record = DoorRecord(
        completed=len(episodes),
        successes=int(np.asarray(episodes["success"]).sum()),
        episodes_sha256=digest,
        **facts,
    )
    folder = driven_folder(root, "doors", record)
    write_record(folder / "run.json", record, folder / "episodes.parquet", data)
    return folder


def read_doors(root: Path) -> list[DoorRun]:
    """Every run under a folder, sorted by controller, condition, seed and source.

    Raises: StoreError when one cannot be read or its episodes are not those it was written with.
    """
    runs = [_read(path) for path in root.glob("doors/*/*/*/run.json")]
    return sorted(
        runs,
        key=lambda run: (run.record.controller, run.record.condition, run.record.seed, run.record.source),
    )


def _read(path: Path) -> DoorRun:
    beside = path.with_name("episodes.parquet")
    record, table = read_record(path, DoorRecord, beside, "episodes_sha256", COLUMNS)
    run = DoorRun(record, table.to_pandas())
    refuse_values(path, _mistakes(run))
    refuse_values(beside, not_finite(run.episodes, ("x", "y", "z", "yaw", "angle", "final_angle")))
    return run


def _mistakes(run: DoorRun) -> Iterator[tuple[str, object, str]]:
    """(field, value, what is valid) of what the data beside a record contradict."""
    record, episodes = run
    if record.completed != len(episodes):
        yield "completed", record.completed, f"{len(episodes)}, the rows beside it"
    if not 0 < record.completed <= record.requested:
        yield "completed", record.completed, f"1 to {record.requested}, as many as requested"
    if record.successes != int(np.asarray(episodes["success"]).sum()):
        yield "successes", record.successes, "as many as the rows beside it"
    for name in set(episodes["outcome"]) - {STOOD, *map(str, TERMINATED)}:
        yield "outcome", f"'{name}'", ", ".join((STOOD, *map(str, TERMINATED)))


COLUMNS = {
    **dict.fromkeys(("x", "y", "z", "yaw", "angle", "final_angle", "first_closed"), "double"),
    **{"outcome": "string", "steps": "int64", "success": "bool"},
}


def door_table(runs: list[DoorRun], labels: Mapping[str, str] | None = None) -> Table:
    """A row per run; `labels` maps a spec to its name."""
    labels = labels or {}
    rows, data = [], []
    for record, episodes in runs:
        rate = stats.wilson(record.successes, record.completed)
        stood = np.asarray(episodes["outcome"] == STOOD)
        falls = int((~stood).sum())
        final = pd.Series(episodes["final_angle"][stood] * DEG)
        took = pd.Series(episodes["first_closed"][episodes["success"]])
        digest = record.policy_sha256
        rows.append(
            (
                f"{record.source} `{digest[:12]}`" if digest else record.source,
                labels.get(record.controller, f"`{record.controller}`"),
                record.condition,
                str(record.seed),
                f"{record.successes}/{record.completed}",
                f"{rate.low * 100:.1f} to {rate.high * 100:.1f}",
                str(falls),
                *(number_text(value, 1) for value in (final.median(), final.max(), took.median())),
            )
        )
        data.append(
            {"source": record.source, "policy_sha256": digest or "", "controller": record.controller}
            | {"condition": record.condition, "seed": record.seed, "requested": record.requested}
            | {"completed": record.completed, "successes": record.successes, "rate": rate.point}
            | {"wilson_low": rate.low, "wilson_high": rate.high, "falls": falls}
            | {"final_angle_median_deg": final.median(), "final_angle_max_deg": final.max()}
            | {"first_closed_median_s": took.median()}
        )
    header = (
        *("Source", "Controller", "Condition", "Doors of seed", "Closed ↑", "95 % interval (%)", "Falls ↓"),
        *("Final angle, median ↓ (deg)", "Largest ↓ (deg)", "Closed after (s)"),
    )
    notes = [
        "The hand pushes a cabinet door shut; the same doors for every row of a seed. `Closed`: the door is "
        "closed at the end and the robot stands, of the doors tried; interval: Wilson. Angles are of "
        "episodes that ended standing; `Closed after`: median over the doors that stayed closed.",
    ]
    notes += [
        f"A door counts as closed below {angle * DEG:.1f} degrees; an episode lasts {duration:g} s."
        for angle, duration in sorted({(run.record.closed_below, run.record.duration) for run in runs})
    ]
    driven = dict.fromkeys(run.record.controller for run in runs)
    notes += names_note({spec: labels[spec] for spec in driven if spec in labels})
    return Table("doors", "Doors pushed shut", header, tuple(rows), tuple(notes), pd.DataFrame(data))
