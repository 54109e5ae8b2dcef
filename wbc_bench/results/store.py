"""The results folder: one record and one file of episodes per run, written atomically, shard by shard.

    <root>/runs/<protocol>/<controller>/replicate_<k>/run.json, episodes.parquet
                                                      shards/shard_00000.parquet ... while it runs

The bytes of episodes.parquet are a function of protocol, controller and replicate alone: who computed
which shard, when, and after how many interruptions stands only in run.json.
"""

import contextlib
import fcntl
import hashlib
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.files import folder_name, write_atomic
from wbc_bench.outcomes import Outcome, SuccessRule

DIFFERS = {  # field of a key -> what it is, in words
    "protocol": "protocol",
    "protocol_digest": "version of the protocol",
    "manifest_sha256": "manifest",
    "controller": "controller",
    "replicate": "replicate",
    "requested": "number of episodes",
    "shard_episodes": "size of shards",
    "software_sha256": "version of the software",
    "controller_sha256": "version of the controller or its files",
}
LABELS = ("stratum", "condition", "orientation", "outcome")  # few values: dictionary-encoded


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
        try:
            data = path.read_bytes()
        except OSError as error:
            raise StoreError(f"cannot read '{path}': {error.strerror}") from error
        sha256 = hashlib.sha256(data).hexdigest()
        if sha256 != self.record.episodes_sha256:
            raise StoreError(
                f"'{path}' is not what its run.json was written for: sha256 {sha256[:16]}..., "
                f"recorded {self.record.episodes_sha256[:16]}..."
            )
        table = pq.read_table(pa.BufferReader(data))
        written = table.schema.metadata or {}
        for name, value in _identity(self.record).items():
            found = written.get(name.encode(), b"").decode()
            if found != value:
                raise StoreError(f"'{path}' was written for {name} '{found}', its run.json says '{value}'")
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
        runs = [Run(path.parent, _read_record(path)) for path in sorted(self.root.glob(pattern))]
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
        """A finished run by its folder, or by <protocol>/<controller>/replicate_<k> below this store.

        Raises: UnknownNameError (with the nearest names), StoreError.
        """
        for folder in (Path(name), self.root / "runs" / name):
            if (folder / "run.json").exists():
                return Run(folder, _read_record(folder / "run.json"))
        known = [str(run.path.relative_to(self.root / "runs")) for run in self.runs()]
        raise UnknownNameError("run", name, known, f"a folder, or below '{self.root / 'runs'}'")

    def run_path(self, protocol: str, controller: str, replicate: int) -> Path:
        """The folder of a run."""
        folder = self.root / "runs" / folder_name(protocol) / folder_name(controller)
        return folder / f"replicate_{replicate}"

    def unfinished(self) -> list[tuple[Path, int]]:
        """(folder, shards on disk) of runs that were interrupted."""
        folders = sorted(self.root.glob("runs/*/*/replicate_*/shards"))
        return [
            (folder.parent, len(list(folder.glob("shard_*.parquet"))))
            for folder in folders
            if not (folder.parent / "run.json").exists()
        ]


class RunWriter:
    """A run being written: which shards are missing, and the merge when none is.

    One process at a time holds a run; the lock vanishes with the process, however it ends.
    """

    def __init__(self, store: ResultStore, key: RunKey, overwrite: bool = False) -> None:
        """Open or create the folder of a run; `overwrite` replaces an earlier one once this one is whole.

        Raises:
            StoreError: The folder is in use, or holds a run of another key and `overwrite` is False.
        """
        self.key = key
        self.path = store.run_path(key.protocol, key.controller, key.replicate)
        self._shards = self.path / "shards"
        _make(self.path)
        self._lock = _lock(self.path)
        try:
            for pattern in (".episodes.parquet.*.tmp", ".run.json.*.tmp", "shards/.shard_*.tmp"):
                for leftover in self.path.glob(pattern):  # of a process that was killed while writing
                    leftover.unlink()
            self.finished = None if overwrite else self._finished()
            if self.finished:
                self._drop_shards()  # it may have been killed between the record and the clean-up
                self.done: dict[int, ShardCost] = {}
            else:
                self.done = self._whole_shards(overwrite)
        except BaseException:
            self.close()
            raise
        self.resumed = len(self.done)

    @property
    def num_shards(self) -> int:
        return -(-self.key.requested // self.key.shard_episodes)

    @property
    def missing(self) -> list[int]:
        """Numbers of the shards that are still to be computed."""
        return [] if self.finished else [k for k in range(self.num_shards) if k not in self.done]

    def rows(self, shard: int) -> range:
        """Rows of the replicate that a shard holds."""
        start = shard * self.key.shard_episodes
        return range(start, min(start + self.key.shard_episodes, self.key.requested))

    def write(self, shard: int, episodes: pa.Table, cost: ShardCost) -> None:
        """Keep one shard: a file that is there is whole."""
        self._write(shard, episodes, cost)
        self.done[shard] = cost

    def _write(self, shard: int, episodes: pa.Table, cost: ShardCost) -> None:
        _make(self._shards)
        facts = {"key": msgspec.json.encode(self.key), "cost": msgspec.json.encode(cost)}
        write_atomic(self._shard_path(shard), _parquet(episodes, facts, checksum=True))

    def finish(self, facts: Mapping[str, Any]) -> Run:
        """Merge the shards, write the record, then remove the shards; `facts` completes the record."""
        tables = [_read_table(self._shard_path(k)) for k in range(self.num_shards)]
        episodes = pa.concat_tables([table.replace_schema_metadata() for table in tables]).combine_chunks()
        key = self.key
        data = _parquet(episodes, _identity(key))
        outcomes = episodes["outcome"].to_pylist()
        record = RunRecord(
            **msgspec.structs.asdict(key),
            completed=len(episodes),
            episodes_sha256=hashlib.sha256(data).hexdigest(),
            outcomes={str(outcome): outcomes.count(str(outcome)) for outcome in Outcome},
            resumed_shards=self.resumed,
            compute_time_s=round(sum(cost.seconds for cost in self.done.values()), 3),
            max_rss_mib=round(max(cost.max_rss_mib for cost in self.done.values()), 1),
            **facts,
        )
        write_atomic(self.path / "episodes.parquet", data)
        # The record comes last: a run without it is unfinished, whatever else is there.
        write_atomic(
            self.path / "run.json", msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n"
        )
        self._drop_shards()
        self.finished = Run(self.path, record)
        return self.finished

    def close(self) -> None:
        """Let go of the lock; remove the folder if nothing was written."""
        with contextlib.suppress(OSError):
            self._shards.rmdir()
        with contextlib.suppress(OSError):
            self.path.rmdir()
        os.close(self._lock)

    def _shard_path(self, shard: int) -> Path:
        return self._shards / f"shard_{shard:05d}.parquet"

    def _finished(self) -> Run | None:
        path = self.path / "run.json"
        if not path.exists():
            return None
        run = Run(self.path, _read_record(path))
        record = run.record
        self._refuse_mixing(record, path, ignore={"software_sha256", "controller_sha256", "requested"})
        if record.controller_sha256 not in (None, self.key.controller_sha256):
            raise StoreError(
                f"'{path}' was evaluated when the code or the files of '{record.controller}' were others; "
                "give another --out, or --overwrite to evaluate it again"
            )
        if self._shards.exists() and not run.whole:
            return None  # killed while the episodes were replaced: the shards are there still
        if record.requested < self.key.requested:
            self._grow_from(run)
            return None
        return run

    def _grow_from(self, run: Run) -> None:
        """Make shards of a run with fewer episodes; its last one, where it is short, is computed again."""
        if run.record.software_sha256 != self.key.software_sha256:
            raise StoreError(
                f"'{run.path}' holds {run.record.requested} of the {self.key.requested} episodes asked for, "
                "evaluated by other code or packages than now; give another --out, or --overwrite"
            )
        episodes, record = run.table(), run.record
        for shard in range(self.num_shards):
            rows = self.rows(shard)
            if rows.stop <= len(episodes) and not self._shard_path(shard).exists():
                share = len(rows) / len(episodes)
                cost = ShardCost(round(record.compute_time_s * share, 3), record.max_rss_mib)
                self._write(shard, episodes.slice(rows.start, len(rows)), cost)

    def _whole_shards(self, overwrite: bool) -> dict[int, ShardCost]:
        """Whole shards of an earlier session; a damaged one is moved aside and computed again.

        With `overwrite` those of another key are not refused but computed again.
        """
        whole = {}
        for shard in range(self.num_shards):
            path = self._shard_path(shard)
            if not path.exists():
                continue
            try:
                table = _read_table(path, page_checksum_verification=True)
                facts = table.schema.metadata or {}
                key = msgspec.json.decode(facts[b"key"], type=RunKey)
                cost = msgspec.json.decode(facts[b"cost"], type=ShardCost)
            except (OSError, KeyError, pa.ArrowException, msgspec.MsgspecError):
                path.replace(path.with_suffix(".damaged"))
                continue
            if overwrite and msgspec.structs.replace(key, requested=self.key.requested) != self.key:
                continue
            self._refuse_mixing(key, path, ignore={"requested"})
            if len(table) == len(self.rows(shard)):
                whole[shard] = cost
        return whole

    def _refuse_mixing(self, other: RunKey | RunRecord, path: Path, ignore: Collection[str] = ()) -> None:
        for name in self.key.__struct_fields__:
            here, there = getattr(self.key, name), getattr(other, name)
            if name not in ignore and here != there:
                raise StoreError(
                    f"'{path}' was evaluated with a different {DIFFERS[name]}: {name} is {there}, asked for "
                    f"{here}; give another --out, or --overwrite to evaluate it again"
                )

    def _drop_shards(self) -> None:
        for path in self._shards.glob("shard_*.parquet"):  # whatever else is there is not ours
            path.unlink()
        with contextlib.suppress(OSError):
            self._shards.rmdir()


def _parquet(table: pa.Table, facts: Mapping[str, str | bytes], checksum: bool = False) -> bytes:
    sink = pa.BufferOutputStream()
    table = table.replace_schema_metadata(dict(facts))
    pq.write_table(
        table,
        sink,
        compression="zstd",
        use_dictionary=[name for name in LABELS if name in table.column_names],  # pyright: ignore[reportArgumentType]
        write_page_checksum=checksum,
    )
    return sink.getvalue().to_pybytes()


def _identity(of: RunKey | RunRecord) -> dict[str, str]:
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


def _read_record(path: Path) -> RunRecord:
    try:
        return msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except (OSError, msgspec.MsgspecError) as error:
        raise StoreError(f"cannot read run record '{path}': {error}") from error


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot create '{folder}': {error.strerror}") from error


def _lock(folder: Path) -> int:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise StoreError(f"'{folder}' is being written by another process") from error
    except OSError:
        pass  # a file system without locks
    return descriptor


def _read_table(path: Path, **options: Any) -> pa.Table:
    # its bytes: pyarrow would take a path with a tilde or a colon for a home folder or a URI
    return pq.read_table(pa.BufferReader(path.read_bytes()), **options)
