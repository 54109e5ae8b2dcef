"""Who computes which shard: this process, processes of this machine, or a dask cluster.

A shard is a fixed number of neighbouring episodes on one thread, with a controller built for it alone, so
that its rows depend neither on who computes it nor on what that process computed before. Workers return rows;
only the client writes.
"""

import os
import resource
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from wbc_bench import provenance
from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError, ControllerError, UnknownNameError
from wbc_bench.outcomes import EpisodeBatch
from wbc_bench.progress import Progress
from wbc_bench.registry import load_controller, spec_of_replicate
from wbc_bench.results import metrics
from wbc_bench.results.store import ResultStore, Run, RunKey, RunWriter, ShardCost
from wbc_bench.robot import load_robot
from wbc_bench.rollout import evaluate

SHARD_EPISODES = 50
ENGINES = ("loky", "dask")
CONNECT_TIMEOUT = 10.0  # [s] for a dask scheduler to answer
MAX_DEATHS = 3  # in a row without a finished shard: then the shard kills its worker, not bad luck


class ExecutionError(BenchError):
    """Workers that cannot be started, or that keep dying."""


@dataclass(frozen=True)
class Engine:
    """Where shards run."""

    workers: int = 1
    name: str = "loky"
    address: str | None = None  # of a dask scheduler; None starts a cluster on this machine

    @classmethod
    def parse(cls, text: str, workers: int) -> "Engine":
        """`loky`, `dask` or `dask=ADDRESS`.

        Raises: UnknownNameError for any other engine.
        """
        name, _, address = text.partition("=")
        if name not in ENGINES or (address and name != "dask"):
            raise UnknownNameError("engine", text, (*ENGINES, "dask=ADDRESS"), "--engine")
        return cls(workers, name, address or None)


@dataclass(frozen=True)
class Job:
    """Some replicates of one protocol under one controller."""

    protocol: EvalProtocol
    manifest: EpisodeManifest
    manifest_sha256: str
    spec: str
    replicates: Sequence[int]
    episodes: int  # of each replicate


class Task(NamedTuple):
    """One shard, as it travels to a worker."""

    run: int
    shard: int
    spec: str
    protocol: EvalProtocol
    rows: EpisodeManifest


class Result(NamedTuple):
    """One shard, as it comes back."""

    run: int
    shard: int
    episodes: pa.Table
    started: float  # [s] Unix time
    cost: ShardCost


def evaluate_shard(spec: str, protocol: EvalProtocol, rows: EpisodeManifest) -> pa.Table:
    """The episode record of some manifest rows: one row an episode, one column a metric."""
    controller = load_controller(spec, load_robot(protocol.robot))
    return episode_table(rows, evaluate(controller, protocol, rows))


def episode_table(rows: EpisodeManifest, batch: EpisodeBatch) -> pa.Table:
    """The record of episodes: what was asked, how they ended, and every metric."""
    columns: dict[str, Any] = {
        "replicate": rows.replicate,
        "episode": rows.episode,
        **{
            name: pa.array(getattr(rows, name), pa.string())
            for name in ("stratum", "condition", "orientation")
        },
        "height": rows.height,
        "target_x": rows.target_pos_w[:, 0],
        "target_y": rows.target_pos_w[:, 1],
        "outcome": pa.array([str(outcome) for outcome in batch.outcome], pa.string()),
        "steps": batch.steps,
        **metrics.compute(batch),
    }
    return pa.table(columns)


def run_jobs(jobs: Sequence[Job], store: ResultStore, engine: Engine, redo: bool = False) -> list[Run]:
    """Evaluate what the store does not hold yet; finished shards of an interrupted evaluation are kept.

    Raises:
        StoreError: the store holds other answers under the same name, is in use or is full.
        ControllerError: a controller cannot be built or breaks the interface.
        ExecutionError: workers cannot be started or keep dying.
    """
    with ExitStack() as stack:
        runs = []
        for job in jobs:
            built: dict[str, tuple[Controller, str]] = {}  # spec -> controller, digest of its software
            for replicate in job.replicates:
                # one controller may meet all replicates, or another one each
                spec = spec_of_replicate(job.spec, replicate)
                if spec not in built:
                    controller = load_controller(spec, load_robot(job.protocol.robot))
                    built[spec] = controller, provenance.software_digest(controller)
                runs.append(_Run(job, spec, *built[spec], replicate, store, redo))
                stack.callback(runs[-1].writer.close)
        tasks = (task for number, run in enumerate(runs) for task in run.tasks(number))
        shared = {
            **{"workers": engine.workers, "engine": engine.name},
            **{"versions": provenance.versions(), "machine": provenance.machine()},
        }
        shared["git_commit"], shared["git_dirty"] = provenance.commit()
        for run in runs:
            run.report_kept()
            run.finish_if_whole(shared)  # killed between the last shard and the merge
        missing = sum(len(run.writer.rows(shard)) for run in runs for shard in run.writer.missing)
        if missing:
            with Progress("episodes") as progress:
                for result in _results(tasks, engine):
                    run = runs[result.run]
                    run.accept(result)
                    done = progress.done + len(result.episodes)
                    progress.update(done, missing, f"{run.job.spec} replicate {run.replicate}")
                    run.finish_if_whole(shared)
        return [run.writer.finished for run in runs if run.writer.finished]


class _Run:
    """One run of a job while it is evaluated."""

    def __init__(
        self,
        job: Job,
        spec: str,
        controller: Controller,
        software: str,
        replicate: int,
        store: ResultStore,
        redo: bool,
    ) -> None:
        self.job, self.replicate = job, replicate
        self._spec = spec  # of the controller that meets this replicate
        self._controller = controller
        self._rows = job.manifest.of_replicate(replicate, job.episodes)
        self._started = float("inf")
        key = RunKey(
            protocol=job.protocol.name,
            protocol_digest=job.protocol.digest,
            manifest_sha256=job.manifest_sha256,
            controller=job.spec,
            replicate=replicate,
            requested=len(self._rows),
            shard_episodes=SHARD_EPISODES,
            software_sha256=software,
        )
        self.writer = RunWriter(store, key, redo)

    def tasks(self, number: int) -> Iterator[Task]:
        for shard in self.writer.missing:
            rows = self._rows.take(np.asarray(self.writer.rows(shard)))
            yield Task(number, shard, self._spec, self.job.protocol, rows)

    def report_kept(self) -> None:
        """Say what is not evaluated again, and whether other code made it: nobody may take it for new."""
        writer, name = self.writer, f"{self.job.spec} replicate {self.replicate}"
        if writer.finished:
            record = writer.finished.record
            line = f"{name}: kept, evaluated {record.created}"
            if record.software_sha256 != writer.key.software_sha256:
                line += " by other code or packages than now; --redo evaluates it again"
            print(line, file=sys.stderr)
        elif writer.resumed:
            print(f"{name}: resumed after {writer.resumed} of {writer.num_shards} shards", file=sys.stderr)

    def accept(self, result: Result) -> None:
        self._started = min(self._started, result.started)
        self.writer.write(result.shard, result.episodes, result.cost)

    def finish_if_whole(self, shared: dict[str, Any]) -> None:
        if self.writer.finished or self.writer.missing:
            return
        now, info = time.time(), self._controller.info
        self.writer.finish(
            {
                "controller_name": info.name,
                "signals": sorted(info.signals),
                "source": info.source,
                "checkpoint_sha256": getattr(self._controller, "checkpoint_sha256", None),
                "wall_time_s": round(max(0.0, now - self._started), 3),  # 0 when only the merge was left
                "created": datetime.fromtimestamp(now, UTC).isoformat(timespec="seconds"),
                **shared,
            }
        )


def _work(task: Task) -> Result:
    """One shard, on the worker."""
    started = time.time()
    try:
        episodes = evaluate_shard(task.spec, task.protocol, task.rows)
    except BenchError as error:  # every subclass as one that survives pickling
        raise ControllerError(str(error)) from None
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MiB]
    return Result(task.run, task.shard, episodes, started, ShardCost(time.time() - started, rss))


def _work_for(client: int, task: Task) -> Result:
    """One shard, on a worker that does not outlive its client."""
    _leave_with(client)
    return _work(task)


@cache
def _leave_with(client: int) -> None:
    """End this process once its parent is gone: loky's workers outlive a killed one, holding their memory."""

    def watch() -> None:
        while os.getppid() == client:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _results(tasks: Iterable[Task], engine: Engine) -> Iterator[Result]:
    """Results in the order in which they are ready."""
    if engine.name == "dask":
        return _on_dask(tasks, engine)
    if engine.workers == 1:
        return map(_work, tasks)
    return _on_loky(tasks, engine.workers)


def _on_loky(tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    pending = {(task.run, task.shard): task for task in tasks}
    deaths = 0
    while pending:
        try:
            with parallel_config("loky", inner_max_num_threads=1):
                # max_nbytes: rows are small, and a temporary folder of memory maps would outlive a kill
                options: Any = {"batch_size": 1, "max_nbytes": None}
                parallel = Parallel(workers, return_as="generator_unordered", **options)
                client = os.getpid()
                results: Any = parallel(delayed(_work_for)(client, task) for task in list(pending.values()))
                for result in results:
                    del pending[result.run, result.shard]
                    deaths = 0
                    yield result
        except BrokenProcessPool as error:  # one dead worker takes the whole pool down
            deaths += 1
            if deaths == MAX_DEATHS:
                raise ExecutionError(
                    f"a worker died {deaths} times in a row ({len(pending)} shards missing); "
                    "finished shards are kept: run again, with fewer --workers if memory ran out"
                ) from error


def _on_dask(tasks: Iterable[Task], engine: Engine) -> Iterator[Result]:
    try:
        from distributed import Client, KilledWorker, LocalCluster, as_completed
    except ImportError as error:
        raise ExecutionError(
            "--engine dask needs the package distributed: pip install wbc-bench[cluster]"
        ) from error
    with ExitStack() as stack:
        if engine.address is None:
            options: Any = {"dashboard_address": None}  # no web server
            cluster = LocalCluster(n_workers=engine.workers, threads_per_worker=1, **options)
            where: Any = stack.enter_context(cluster)
        else:
            where = engine.address
        try:
            client = stack.enter_context(Client(where, timeout=CONNECT_TIMEOUT))
        except (OSError, ValueError) as error:
            raise ExecutionError(f"no dask scheduler answers at '{engine.address}': {error}") from error
        queue = iter(tasks)
        # A window instead of everything at once: rows travel when they are needed.
        window = 2 * max(len(client.scheduler_info()["workers"]), engine.workers)
        futures = as_completed(client.submit(_work, task, pure=False) for task in islice(queue, window))
        for future in futures:
            try:
                yield future.result()
            except KilledWorker as error:
                raise ExecutionError(
                    f"dask gave up on a shard that killed its workers: {error}; finished shards are kept"
                ) from error
            futures.update(client.submit(_work, task, pure=False) for task in islice(queue, 1))
