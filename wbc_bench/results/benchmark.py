"""What a benchmark has measured: a table for people, and a record that a later build is compared with."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pandas as pd

from wbc_bench import provenance
from wbc_bench.errors import StoreError
from wbc_bench.readers import read_json
from wbc_bench.results.table import Table

Cell = str | int | float | None  # None where a number is unknown


class BenchmarkRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The rows of one run of a benchmark, and of what: `<name>.json`."""

    benchmark: str
    columns: list[str]
    rows: list[list[Cell]]
    git_commit: str | None
    git_dirty: bool
    versions: dict[str, str]
    machine: dict[str, str | int | float]

    @classmethod
    def of(cls, name: str, frame: pd.DataFrame) -> "BenchmarkRecord":
        """The record of a benchmark that has just been run here. Raises: TypeError: it gave no table."""
        if not isinstance(frame, pd.DataFrame):
            raise TypeError(f"it returned {type(frame).__name__}, valid: a pandas DataFrame")
        commit, dirty = provenance.commit()
        rows = [[None if pd.isna(cell) else _plain(cell) for cell in row] for row in frame.to_numpy(object)]
        columns = list(map(str, frame.columns))
        return cls(name, columns, rows, commit, dirty, provenance.versions(), provenance.machine())

    def json(self) -> bytes:
        """The text of its file."""
        return msgspec.json.format(msgspec.json.encode(self)) + b"\n"


def _plain(cell: Any) -> Cell:
    return cell.item() if hasattr(cell, "item") else cell


def read_benchmark(path: Path) -> BenchmarkRecord:
    """A record that was written before.

    Raises: StoreError: It cannot be read, or its rows do not have the cells that its columns announce.
    """
    record = read_json(path, BenchmarkRecord, "record of a benchmark", StoreError)
    for row in record.rows:
        if len(row) != len(record.columns):
            raise StoreError(
                f"record of a benchmark '{path}' has a row of {len(row)} cells, valid: {len(record.columns)}"
            )
    return record


def benchmark_table(record: BenchmarkRecord) -> Table:
    """The rows as they are."""
    return Table(
        record.benchmark,
        f"Benchmark {record.benchmark}",
        tuple(record.columns),
        tuple(tuple(map(_text, row)) for row in record.rows),
        data=pd.DataFrame(record.rows, columns=pd.Index(record.columns)),
    )


def against_table(now: BenchmarkRecord, before: BenchmarkRecord) -> Table:
    """Every number over that of an earlier record; rows are matched by the first word of their first cell.

    Two runs at different times met different loads, which ratios of processor time forgive in part only.

    Raises: StoreError: The earlier record is of another benchmark.
    """
    if now.benchmark != before.benchmark:
        raise StoreError(
            f"--against: the record is of benchmark '{before.benchmark}', valid: one of '{now.benchmark}'"
        )
    earlier = {_key(row): dict(zip(before.columns, row, strict=True)) for row in before.rows}
    first, *numbers = [
        column for k, column in enumerate(now.columns) if not k or any(_is_number(row[k]) for row in now.rows)
    ]
    cells = []
    for row in now.rows:
        found, old = dict(zip(now.columns, row, strict=True)), earlier.get(_key(row), {})
        cells.append((_text(found[first]), *(_ratio(found[name], old.get(name)) for name in numbers)))
    return Table(
        f"{now.benchmark}_against",
        f"Benchmark {now.benchmark}: this build over commit {(before.git_commit or 'unknown')[:7]}",
        (first, *numbers),
        tuple(cells),
        notes=tuple(_differences(now, before)),
    )


def _key(row: Sequence[Cell]) -> str:
    return str(row[0]).partition(" ")[0] if row else ""


def _is_number(cell: Cell) -> bool:
    return isinstance(cell, int | float)


def _text(cell: Cell) -> str:
    if cell is None:
        return "–"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _ratio(now: Cell, before: Cell) -> str:
    if not isinstance(now, int | float) or not isinstance(before, int | float) or not before:
        return "–"
    return f"{now / before:.3f}"


def _differences(now: BenchmarkRecord, before: BenchmarkRecord) -> list[str]:
    """What else than the build differs, in words."""

    def changes(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
        names = [name for name in sorted({*mine, *theirs}) if mine.get(name) != theirs.get(name)]
        return ", ".join(f"{name} {theirs.get(name, 'none')} → {mine.get(name, 'none')}" for name in names)

    notes = []
    if machine := changes(now.machine, before.machine):
        notes.append(f"Another machine: {machine}; the ratios say little of the build.")
    if versions := changes(now.versions, before.versions):
        notes.append(f"Other packages: {versions}.")
    return notes
