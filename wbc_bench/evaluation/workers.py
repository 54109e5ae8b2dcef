"""Who computes which shard: this process, processes of this machine, or a dask cluster.

Workers return rows; only the client writes.
"""

import resource
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import pyarrow as pa

from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError, ControllerError, UnknownNameError, fault_of, missing_extra
from wbc_bench.evaluation.shard import evaluate_shard
from wbc_bench.parallel import WorkerError, in_parallel
from wbc_bench.results.store import ShardCost

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


class Task(NamedTuple):
    """One shard, as it travels to a worker."""

    run: int
    shard: int
    controller: str | bytes  # as `evaluate_shard` takes it
    protocol: EvalProtocol
    rows: EpisodeManifest
    software: str  # digest that the code must have on the worker


class Result(NamedTuple):
    """One shard, as it comes back."""

    run: int
    shard: int
    episodes: pa.Table
    started: float  # [s] Unix time
    cost: ShardCost


def _work(task: Task) -> Result:
    """One shard, on the worker."""
    started = time.time()
    try:
        episodes = evaluate_shard(task.controller, task.protocol, task.rows, task.software)
    except BenchError as error:  # every subclass as one that survives pickling
        raise ControllerError(str(error)) from None
    except Exception as error:  # a fault of ours; the exception itself may not survive it
        raise RuntimeError("".join(traceback.format_exception(error))) from None
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MiB]
    return Result(task.run, task.shard, episodes, started, ShardCost(time.time() - started, rss))


def _work_apart(task: Task) -> Result:
    """One shard, in a process of its own.

    No interrupt of the user arrives there: processes of loky ignore them, and dask calls this on a thread
    that is not the main one.
    """
    try:
        return _work(task)
    except KeyboardInterrupt as error:  # raised by somebody's code
        name = task.controller if isinstance(task.controller, str) else "handed over"
        said = getattr(error, "__notes__", None) or [f"controller '{name}' raised {fault_of(error)}"]
        raise ControllerError(said[-1]) from None


def results(tasks: Iterable[Task], engine: Engine) -> Iterator[Result]:
    """Results in the order in which they are ready."""
    if engine.name == "dask":
        return _on_dask(tasks, engine)
    if engine.workers == 1:
        return map(_work, tasks)
    return _on_loky(tasks, engine.workers)


def _on_loky(tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    pending = {(task.run, task.shard): task for task in tasks}
    deaths = 0
    while pending:
        try:
            for result in in_parallel(workers, _work_apart, list(pending.values()), ordered=False):
                del pending[result.run, result.shard]
                deaths = 0
                yield result
        except WorkerError as error:
            deaths += 1
            if deaths == MAX_DEATHS:
                raise ExecutionError(
                    f"a worker died {deaths} times in a row ({len(pending)} shards missing); "
                    "finished shards are kept: run again, with fewer --workers if memory ran out"
                ) from error


def _on_dask(tasks: Iterable[Task], engine: Engine) -> Iterator[Result]:
    try:
        from distributed import Client, KilledWorker, as_completed

        from wbc_bench.evaluation.dask_cluster import local_cluster
    except ImportError as error:
        raise ExecutionError(missing_extra("--engine dask", "cluster", error)) from error
    with ExitStack() as stack:
        if engine.address is None:
            where: Any = stack.enter_context(local_cluster(engine.workers))
        else:
            where = engine.address
        try:
            client = stack.enter_context(Client(where, timeout=CONNECT_TIMEOUT))
        except (OSError, ValueError) as error:
            raise ExecutionError(f"no dask scheduler answers at '{engine.address}': {error}") from error
        queue = iter(tasks)
        # A window instead of everything at once: rows travel when they are needed.
        window = 2 * max(len(client.scheduler_info()["workers"]), engine.workers)
        futures = as_completed(client.submit(_work_apart, task, pure=False) for task in islice(queue, window))
        for future in futures:
            try:
                yield future.result()
            except KilledWorker as error:
                raise ExecutionError(
                    f"dask gave up on a shard that killed its workers: {error}; finished shards are kept"
                ) from error
            futures.update(client.submit(_work_apart, task, pure=False) for task in islice(queue, 1))
