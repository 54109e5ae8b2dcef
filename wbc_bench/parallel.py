"""Work shared out to processes of this machine, none of which outlives the process that shared it out."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from wbc_bench.errors import BenchError

Item = TypeVar("Item")
Found = TypeVar("Found")


class WorkerError(BenchError):
    """A worker process that died: it was killed, or memory ran out."""


def in_parallel(
    workers: int, work: Callable[[Item], Found], items: Iterable[Item], ordered: bool = True
) -> Iterator[Found]:
    """Apply a function to items in `workers` processes, or in this one if it is one.

    Args:
        workers: Number of processes.
        work: The function; it may be a local one.
        items: What it is called with, one at a time.
        ordered: Whether results come in the order of the items, or as soon as they are there.

    Raises:
        WorkerError: A worker died; whatever else the function raises is raised here.
    """
    return map(work, items) if workers == 1 else _in_processes(workers, work, items, ordered)


def _in_processes(
    workers: int, work: Callable[[Item], Found], items: Iterable[Item], ordered: bool
) -> Iterator[Found]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    # max_nbytes: items are small, and a temporary folder of memory maps would outlive a kill
    options: Any = {"batch_size": 1, "max_nbytes": None}
    # when a worker begins, not with its first item: one that was given none would wait for minutes
    leave: Any = {"initializer": _leave_with, "initargs": (os.getpid(),)}
    with parallel_config("loky", inner_max_num_threads=1, **leave):
        parallel = Parallel(workers, return_as="generator" if ordered else "generator_unordered", **options)
    try:
        results: Any = parallel(delayed(work)(item) for item in items)
        yield from results
    except BrokenProcessPool as error:  # one dead worker takes the whole pool down
        raise WorkerError("a worker died: run again, with fewer --workers if memory ran out") from error


def _leave_with(client: int) -> None:
    """End this process once its parent is gone: loky's workers outlive a killed one, holding their memory.

    Until then its parent alone answers an interrupt, with one line instead of a traceback per worker.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == client:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
