"""What a severity ladder leaves behind: a record of its levels, and the episodes that are solved at each.

`<root>/stress/<ladder>/` is a folder of records of its own: ladder.json, `runs/<level>/<controller>/...`
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import StoreError
from wbc_bench.files import folder_name, write_atomic
from wbc_bench.readers import is_file, read_json
from wbc_bench.results.analysis import Evaluated, collect_all, column
from wbc_bench.results.records import refuse_values
from wbc_bench.results.store import ResultStore

FloatArray = NDArray[np.float64]
RECORD = "ladder.json"


class LevelRecord(msgspec.Struct, frozen=True):
    """One severity and the protocol that has it."""

    severity: float
    protocol: str  # its name, and that of its runs' folder
    digest: str  # of the protocol


class FactorRecord(msgspec.Struct, frozen=True):
    """A disturbance and its levels, from mild to severe."""

    name: str
    label: str
    unit: str
    levels: tuple[LevelRecord, ...]

    @property
    def severities(self) -> FloatArray:
        """(L,) rising or falling."""
        return np.array([level.severity for level in self.levels])


class LadderRecord(msgspec.Struct, frozen=True):
    """A ladder, whichever of its levels were evaluated."""

    name: str
    source: str  # name of the protocol that it is built on
    base: LevelRecord  # that protocol's episodes; the severity has no meaning
    episodes: int  # of each level
    factors: tuple[FactorRecord, ...]


@dataclass(frozen=True)
class Climb:
    """Which episodes one controller solved, at the base and at every level of the factors that are whole."""

    spec: str
    name: str  # label, or spec without one
    records: tuple[Any, ...]  # of all its runs
    base: FloatArray  # (N,) 0 or 1
    levels: Mapping[str, FloatArray]  # factor -> (N, L), the same episodes

    @property
    def episodes(self) -> int:
        """Episodes that all of them have."""
        return len(self.base)

    def first(self, episodes: int) -> "Climb":
        """The same with the first episodes alone."""
        levels = {name: solved[:episodes] for name, solved in self.levels.items()}
        return Climb(self.spec, self.name, self.records, self.base[:episodes], levels)


@dataclass(frozen=True)
class Stress:
    """A ladder and the controllers that were evaluated on it."""

    ladder: LadderRecord
    climbs: tuple[Climb, ...]  # in the order of their labels, those without one last


def stress_folder(root: Path, ladder: str) -> Path:
    """Where the records of a ladder stand below a folder of results."""
    return root / "stress" / folder_name(ladder)


def keep_ladder(folder: Path, record: LadderRecord) -> None:
    """Write the record of a ladder into its folder.

    Raises:
        StoreError: Another ladder of that name has records there, or the folder cannot be written.
    """
    path = folder / RECORD
    if is_file(path):
        if read_ladder(path) != record:
            raise StoreError(
                f"'{path}' is of another ladder '{record.name}', of other levels, episodes or base: give "
                "this one another name, or another --out"
            )
        return
    write_atomic(path, msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n")


def read_ladder(path: Path) -> LadderRecord:
    """The record of a ladder.

    Raises: StoreError when it cannot be read or contradicts itself.
    """
    record = read_json(path, LadderRecord, "ladder record", StoreError)
    refuse_values(path, _mistakes(record))
    return record


def _mistakes(record: LadderRecord) -> Iterator[tuple[str, object, str]]:
    """(field, value, what is valid) of what the types of the fields cannot say."""
    if record.episodes < 1:
        yield "episodes", record.episodes, "1 or more"
    names = [factor.name for factor in record.factors]
    if not names or len(set(names)) < len(names):
        yield "factors", ", ".join(names) or "empty", "at least one, each once"
    for factor in record.factors:
        steps = np.diff(factor.severities)
        if not len(steps) or not np.isfinite(steps).all() or not ((steps > 0).all() or (steps < 0).all()):
            yield f"levels of {factor.name}", factor.severities.tolist(), "two or more that rise or fall"


def read_stress(root: Path, labels: Mapping[str, str] | None = None) -> list[Stress]:
    """Every ladder under a folder of results that a controller was evaluated on, sorted by name.

    Args:
        root: The folder.
        labels: Spec -> name in tables and figures, in the order of the tables.

    Raises:
        StoreError: A record cannot be read, or a run is not one of its ladder's.
    """
    found = []
    for path in sorted(root.glob(f"stress/*/{RECORD}")):
        ladder = read_ladder(path)
        if path.parent != stress_folder(root, ladder.name):
            raise StoreError(
                f"'{path}' is of ladder '{ladder.name}': is the folder a copy? give it its own name back"
            )
        climbs = _climbs(ladder, path.parent, labels or {})
        if climbs:
            found.append(Stress(ladder, climbs))
    return found


def _climbs(ladder: LadderRecord, folder: Path, labels: Mapping[str, str]) -> tuple[Climb, ...]:
    store = ResultStore(folder)
    digests = {level.protocol: level.digest for factor in ladder.factors for level in factor.levels}
    digests[ladder.base.protocol] = ladder.base.digest
    runs = store.runs()
    for run in runs:
        if digests.get(run.record.protocol) != run.record.protocol_digest:
            raise StoreError(f"'{run.path}' is not of a level of '{folder / RECORD}': remove one of them")
    evaluated = collect_all(runs, labels)
    whole = evaluated.get(ladder.base.protocol, {})
    order = [*labels, *sorted(whole.keys() - labels.keys())]
    return tuple(_climb(spec, ladder, evaluated) for spec in order if spec in whole)


def _climb(spec: str, ladder: LadderRecord, evaluated: Mapping[str, Mapping[str, Evaluated]]) -> Climb:
    """What a controller solved; a factor with a level that is still missing is left out."""

    def run(level: LevelRecord) -> Evaluated | None:
        return evaluated.get(level.protocol, {}).get(spec)

    base = evaluated[ladder.base.protocol][spec]
    runs = {factor.name: [run(level) for level in factor.levels] for factor in ladder.factors}
    whole = {name: [level for level in levels if level] for name, levels in runs.items() if all(levels)}
    used = [base, *(level for levels in whole.values() for level in levels)]
    # runs hold the first episodes of the level's manifest, whatever their number
    count = min(len(level.episodes) for level in used)
    solved = {
        name: np.column_stack([column(level.episodes, "success")[:count] for level in levels])
        for name, levels in whole.items()
    }
    records = {record.protocol: record for level in used for record in level.records}
    return Climb(spec, base.name, tuple(records.values()), column(base.episodes, "success")[:count], solved)
