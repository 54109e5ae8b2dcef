"""The results folder: one record and one file of episodes per run, written atomically, shard by shard.

    <root>/runs/<protocol>/<controller>/replicate_<k>/run.json, episodes.parquet
                                                      shards/shard_00000.parquet ... while it runs

The bytes of episodes.parquet are a function of protocol, controller and replicate alone: who computed
which shard, when, and after how many interruptions stands only in run.json.
"""

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd
import pyarrow as pa

from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.files import folder_name, write_atomic
from wbc_bench.outcomes import Outcome, SuccessRule
from wbc_bench.readers import decode_parquet, is_file, read_bytes, read_json
from wbc_bench.results.records import refuse_values

KEYS = {"episode": "int64", "outcome": "string"}  # columns of every file of episodes


class RunKey(msgspec.Struct, frozen=True, kw_only=True):
    """What identifies a run. Shards of different keys must not be merged."""

    protocol: str
    protocol_digest: str
    manifest_sha256: str
    controller: str  # the spec as it was given
    replicate: int
    requested: int  # episodes
    shard_episodes: int
    software_sha256: str  # all code that computes an episode, its controller's too, and the packages
    controller_sha256: str | None = None  # of the controller's own part of it


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Where the episodes beside it come from."""

    protocol: str
    protocol_digest: str
    manifest_sha256: str
    controller: str
    controller_name: str
    signals: list[str]
    source: str
    replicate: int
    requested: int
    completed: int
    episodes_sha256: str  # of episodes.parquet
    resolved_controller: str | None = None  # the spec that met this replicate; None in records before 0.1.0
    controller_sha256: str | None = None  # its code and files; None in records before 0.1.0
    checkpoint_sha256: str | None
    outcomes: dict[str, int]  # name -> episodes; they add up to `completed`
    software_sha256: str
    git_commit: str | None
    git_dirty: bool
    versions: dict[str, str]
    machine: dict[str, str | int | float]
    shard_episodes: int
    workers: int
    engine: str
    resumed_shards: int  # found from an earlier, interrupted session
    wall_time_s: float  # [s] of the session that finished the run
    compute_time_s: float  # [s] summed over shards
    max_rss_mib: float  # [MiB] largest resident set of any worker
    created: str  # UTC, ISO 8601
    commands: list[str] = []  # parts of its commands beside positions, see `JointCommand`
    # A record without the field was made under the v1 protocols, whose rule the defaults are.
    rule: SuccessRule = SuccessRule()


class ShardCost(NamedTuple):
    """What one shard took."""

    seconds: float
    max_rss_mib: float


@dataclass(frozen=True)
class Run:
    """A finished run."""

    path: Path
    record: RunRecord

    def episodes(self) -> pd.DataFrame:
        """One row per episode. Raises: StoreError, see `table`."""
        return self.table().to_pandas()

    @property
    def whole(self) -> bool:
        """Whether the episodes are those that the record was written for."""
        try:
            self.table()
        except StoreError:
            return False
        return True

    def table(self) -> pa.Table:
        """One row per episode, without what the file says of itself.

        Raises: StoreError when the file is missing, or not the one that the record was written for.
        """
        path = self.path / "episodes.parquet"
        data = read_bytes(path, "episodes", StoreError)
        sha256 = hashlib.sha256(data).hexdigest()
        if sha256 != self.record.episodes_sha256:
            raise StoreError(
                f"'{path}' is not what its run.json was written for: sha256 {sha256[:16]}..., "
                f"recorded {self.record.episodes_sha256[:16]}..."
            )
        table = decode_parquet(data, path, "episodes", StoreError, KEYS, self.record.completed)
        written = table.schema.metadata or {}
        for name, value in identity(self.record).items():
            found = written.get(name.encode(), b"").decode(errors="replace")
            if found != value:
                raise StoreError(f"'{path}' was written for {name} '{found}', its run.json says '{value}'")
        ended = Counter(table["outcome"].to_pylist())
        if ended != Counter({name: count for name, count in self.record.outcomes.items() if count}):
            raise StoreError(f"'{path}' ended with {dict(ended)}, its run.json says {self.record.outcomes}")
        return table.replace_schema_metadata()


class ResultStore:
    """All runs under one folder."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    def runs(self, protocol: str | None = None) -> list[Run]:
        """Finished runs, sorted by folder, i.e. protocol, controller, replicate.

        Raises:
            StoreError: A record cannot be read, or stands in a folder of another name: a copied folder would
                count its episodes twice.
        """
        pattern = f"runs/{'*' if protocol is None else folder_name(protocol)}/*/replicate_*/run.json"
        runs = [Run(path.parent, read_run_record(path)) for path in sorted(self.root.glob(pattern))]
        for run in runs:
            _check_folder(run)
        return runs

    def load(self, protocol: str, controller: str) -> pd.DataFrame:
        """Episodes of all replicates of a controller.

        Raises:
            UnknownNameError: it has no run.
            StoreError: its replicates were evaluated with different protocols or manifests.
        """
        runs = [run for run in self.runs(protocol) if run.record.controller == controller]
        if not runs:
            known = {run.record.controller for run in self.runs(protocol)}
            raise UnknownNameError("evaluated controller", controller, known, f"runs of {protocol}")
        first = runs[0].record
        for run in runs:
            for name in ("protocol_digest", "manifest_sha256"):
                if getattr(run.record, name) != getattr(first, name):
                    raise StoreError(
                        f"runs of '{controller}' under '{protocol}' must not be mixed: {name} is "
                        f"{getattr(first, name)} in {runs[0].path.name}, "
                        f"{getattr(run.record, name)} in {run.path.name}"
                    )
        return pd.concat([run.episodes() for run in runs], ignore_index=True)

    def find(self, name: str) -> Run:
        """A finished run by its folder, or by `<protocol>/<controller>/replicate_<k>` below this store.

        Raises: UnknownNameError (with the nearest names), StoreError.
        """
        for folder in (Path(name), self.root / "runs" / name):
            if is_file(folder / "run.json"):
                return Run(folder, read_run_record(folder / "run.json"))
        known = [str(run.path.relative_to(self.root / "runs")) for run in self.runs()]
        raise UnknownNameError("run", name, known, f"a folder, or below '{self.root / 'runs'}'")

    def run_path(self, protocol: str, controller: str, replicate: int) -> Path:
        """The folder of a run."""
        folder = self.root / "runs" / folder_name(protocol) / folder_name(controller)
        return folder / f"replicate_{replicate}"

    def keep_protocol(self, name: str, protocol: Path, manifest: Path) -> None:
        """Copy a user's own protocol, its manifest and its hash beside the runs.

        Raises: StoreError, see `write_atomic`.
        """
        kept = self.protocol_path(name)
        kept.parent.mkdir(parents=True, exist_ok=True)
        pairs = [(protocol, kept)]
        pairs += [(manifest.with_suffix(end), kept.with_suffix(end)) for end in (manifest.suffix, ".sha256")]
        for source, copy in pairs:
            data = read_bytes(source, "protocol", StoreError)
            if not is_file(copy) or read_bytes(copy, "protocol", StoreError) != data:
                write_atomic(copy, data)

    def protocol_path(self, name: str) -> Path:
        """Where the copy of a user's own protocol stands, if there is one."""
        return self.root / "protocols" / f"{folder_name(name)}.toml"

    def unfinished(self) -> list[tuple[Path, int]]:
        """(folder, shards on disk) of runs that were interrupted."""
        folders = sorted(self.root.glob("runs/*/*/replicate_*/shards"))
        return [
            (folder.parent, len(list(folder.glob("shard_*.parquet"))))
            for folder in folders
            if not (folder.parent / "run.json").exists()
        ]


def identity(of: RunKey | RunRecord) -> dict[str, str]:
    """Which run a file of episodes belongs to, as its metadata say."""
    names = ("protocol", "protocol_digest", "controller", "replicate")
    return {name: str(getattr(of, name)) for name in names}


def _check_folder(run: Run) -> None:
    record = run.record
    expected = (folder_name(record.protocol), folder_name(record.controller), f"replicate_{record.replicate}")
    if run.path.parts[-3:] != expected:
        raise StoreError(
            f"'{run.path}' holds the run of {'/'.join(expected)}: is the folder a copy? "
            "remove it or give it its own name back"
        )


def read_run_record(path: Path) -> RunRecord:
    """The record in a run's folder.

    Raises: StoreError when it cannot be read, or its numbers contradict each other.
    """
    record = read_json(path, RunRecord, "run record", StoreError)
    refuse_values(path, _mistakes(record))
    return record


def _mistakes(record: RunRecord) -> Iterator[tuple[str, object, str]]:
    """(field, value, what is valid) of what the types of the fields cannot say."""
    for name in ("protocol_digest", "manifest_sha256", "episodes_sha256", "software_sha256"):
        if not re.fullmatch("[0-9a-z]{64}", getattr(record, name)):
            yield name, f"'{getattr(record, name)}'", "64 hexadecimal digits"
    for name, low in (("replicate", 0), ("completed", 1), ("shard_episodes", 1)):
        if getattr(record, name) < low:
            yield name, getattr(record, name), f"{low} or more"
    if record.completed != record.requested:
        yield "completed", record.completed, f"{record.requested}, as many as requested"
    for name, count in record.outcomes.items():
        if name not in list(Outcome) or count < 0:
            yield f"outcomes.{name}", count, f"0 or more of {', '.join(Outcome)}"
    if sum(record.outcomes.values()) != record.completed:
        yield "sum of outcomes", sum(record.outcomes.values()), f"{record.completed}, as many as completed"
    for name in record.rule.__struct_fields__:
        if not 0 < getattr(record.rule, name) < math.inf:
            yield f"rule.{name}", getattr(record.rule, name), "above 0"
