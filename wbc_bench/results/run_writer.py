"""A run while it is written: shard by shard, resumable, merged into one file when none is missing."""

import contextlib
import fcntl
import hashlib
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from wbc_bench.errors import StoreError
from wbc_bench.files import write_atomic
from wbc_bench.outcomes import Outcome
from wbc_bench.readers import read_parquet, reading
from wbc_bench.results.store import ResultStore, Run, RunKey, RunRecord, ShardCost, identity, read_run_record

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
        facts["rows_sha256"] = _rows_sha256(episodes).encode()
        write_atomic(self._shard_path(shard), _parquet(episodes, facts))

    def finish(self, facts: Mapping[str, Any]) -> Run:
        """Merge the shards, write the record, then remove the shards; `facts` completes the record."""
        tables = [read_parquet(self._shard_path(k), "shard", StoreError) for k in range(self.num_shards)]
        episodes = pa.concat_tables([table.replace_schema_metadata() for table in tables]).combine_chunks()
        key = self.key
        data = _parquet(episodes, identity(key))
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
        run = Run(self.path, read_run_record(path))
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

        Damaged is what cannot be read, and what are not the rows that were written, whatever they are now.
        With `overwrite` those of another key are not refused but computed again.
        """
        whole = {}
        for shard in range(self.num_shards):
            path = self._shard_path(shard)
            if not path.exists():
                continue
            try:
                table = read_parquet(path, "shard", StoreError)
                facts = table.schema.metadata or {}
                with reading("shard", path, "a shard of this store", StoreError):
                    key = msgspec.json.decode(facts[b"key"], type=RunKey)
                    cost = msgspec.json.decode(facts[b"cost"], type=ShardCost)
                    whole_length = len(table) == len(self.rows(shard))  # else: of another number of episodes
                    if whole_length and facts[b"rows_sha256"].decode() != _rows_sha256(table):
                        raise StoreError(f"shard '{path}' does not hold the rows that were written")
            except StoreError:
                path.replace(path.with_suffix(".damaged"))
                continue
            if overwrite and msgspec.structs.replace(key, requested=self.key.requested) != self.key:
                continue
            self._refuse_mixing(key, path, ignore={"requested"})
            if whole_length:
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


def _rows_sha256(table: pa.Table) -> str:
    return hashlib.sha256(_parquet(table, {})).hexdigest()


def _parquet(table: pa.Table, facts: Mapping[str, str | bytes]) -> bytes:
    sink = pa.BufferOutputStream()
    table = table.replace_schema_metadata(dict(facts))
    pq.write_table(
        table,
        sink,
        compression="zstd",
        use_dictionary=[name for name in LABELS if name in table.column_names],  # pyright: ignore[reportArgumentType]
    )
    return sink.getvalue().to_pybytes()


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
