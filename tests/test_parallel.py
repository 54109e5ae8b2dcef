"""Work in processes: the results of one process, and nothing left behind by a killed one."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wbc_bench.errors import BenchError
from wbc_bench.parallel import WorkerError, in_parallel

SHARED_MEMORY = Path("/dev/shm")
SCRIPT = """
import sys, time
from pathlib import Path
import numpy as np
from wbc_bench.parallel import in_parallel

def work(item):
    (Path(sys.argv[1]) / str(number := int(item[0]))).touch()
    time.sleep(600.0 * (number > 0))

list(in_parallel(int(sys.argv[2]), work, [np.full(1_000_000, k) for k in range(3)]))
"""


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("ordered", [True, False])
def test_results_are_those_of_a_loop(workers, ordered):
    offset = 3
    found = list(in_parallel(workers, lambda k: k + offset, range(6), ordered))
    assert found == [3, 4, 5, 6, 7, 8] if ordered else sorted(found) == [3, 4, 5, 6, 7, 8]


def test_a_dead_worker_is_one_line():
    with pytest.raises(WorkerError, match="a worker died: run again, with fewer --workers") as caught:
        list(in_parallel(2, lambda _: os.kill(os.getpid(), signal.SIGKILL), range(2)))
    assert isinstance(caught.value, BenchError)


@pytest.mark.parametrize("workers", [2, 4])
def test_nothing_outlives_a_killed_process(tmp_path, workers):
    """Neither processes, with or without an item, nor shared memory, whatever command shares out the work."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(workers)]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        wait_until(lambda: len(list(tmp_path.iterdir())) == 3)  # two workers are busy, others have no item
        process.kill()
        process.wait()
        wait_until(lambda: not group_exists(process.pid))
        wait_until(lambda: not list(SHARED_MEMORY.glob(f"*[_-]{process.pid}[_-]*")))
    finally:
        if group_exists(process.pid):
            os.killpg(process.pid, signal.SIGKILL)


def wait_until(condition, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def group_exists(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
