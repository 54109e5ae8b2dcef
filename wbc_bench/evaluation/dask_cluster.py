"""A dask cluster of this machine without a web server.

`LocalCluster(dashboard_address=None)` leaves out the pages of the dashboard and still opens its port, 8787,
and one more per worker.
"""

import logging
from typing import Any

from distributed import Nanny, Scheduler, SpecCluster, Worker
from distributed.system import MEMORY_LIMIT

HOST = "127.0.0.1"


class _QuietScheduler(Scheduler):
    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class _QuietWorker(Worker):
    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


def local_cluster(workers: int) -> SpecCluster:
    """A scheduler in this process, and workers in processes of their own, with one thread each.

    They share the memory of the machine equally; dask's own limit is one core's part of it.
    """
    options = {"host": HOST, "nthreads": 1, "worker_class": _QuietWorker, "dashboard": False}
    options["memory_limit"] = MEMORY_LIMIT // workers  # [bytes]
    quiet: Any = logging.WARNING  # a level, as `LocalCluster` hands it on
    return SpecCluster(
        workers={k: {"cls": Nanny, "options": options} for k in range(workers)},
        scheduler={"cls": _QuietScheduler, "options": {"host": HOST, "port": 0, "dashboard": False}},
        silence_logs=quiet,
    )
