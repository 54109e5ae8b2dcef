"""Evaluate very many episodes on a dask cluster, kill a worker midway, and say what an episode costs.

    nice python .ci/scale.py --episodes 100000 --workers 4

Prints the processor time of an episode over that of one process without a cluster, the memory of the largest
process below the evaluation in the second tenth of the time and in the last but one, and whether the store
holds every episode once. Episodes have ten control steps, so that what the bench does around them weighs
most. Exit code 1 when rows are lost or doubled, or it was over before a worker could be killed.
"""

import argparse
import itertools
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))
PER_REPLICATE = 1000


def main() -> int:
    """Run both evaluations and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=4)
    options = parser.parse_args()
    from tiny_protocol import write_tiny
    from wbc_bench.results.store import ResultStore

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        replicates = -(-options.episodes // PER_REPLICATE)
        path = write_tiny(work, replicates, PER_REPLICATE)
        alone, _, _ = _evaluate(path, work / "alone", 1, "--engine", "loky", "--workers", "1")
        cost, memory, killed = _evaluate(
            path, work / "many", replicates, "--engine", "dask", "--workers", str(options.workers), kill=True
        )
        rows = [stored.episodes()["episode"].to_numpy() for stored in ResultStore(work / "many").runs("tiny")]
        whole = len(rows) == replicates and all(
            np.array_equal(np.sort(found), np.arange(PER_REPLICATE)) for found in rows
        )
    tenth = max(len(memory) // 10, 1)
    first, last = (
        1e-6 * float(np.median(part)) for part in (memory[tenth : 2 * tenth], memory[-2 * tenth : -tenth])
    )
    count = replicates * PER_REPLICATE
    print(
        f"{count} episodes on {options.workers} workers, {killed} killed: {sum(map(len, rows))} rows, ",
        end="",
    )
    print(f"{'each episode once' if whole else 'LOST OR DOUBLED'}; processor time an episode ", end="")
    print(
        f"{1e3 * cost / count:.2f} ms, {cost / count / (alone / PER_REPLICATE):.3f} of one process without ",
        end="",
    )
    print(f"a cluster; largest worker {first:.0f} MB in the second tenth, {last:.0f} MB in the last but one")
    return 0 if whole and killed else 1


def _evaluate(
    protocol: Path, out: Path, replicates: int, *options: str, kill: bool = False
) -> tuple[float, list[int], int]:
    """Processor time [s] of all processes, the largest one's memory [B] as it went on, and those killed."""
    command = ["wbc-bench", "eval", "--controller", "hold", "--protocol", str(protocol), "--out", str(out)]
    before = _children()
    memory: list[int] = []
    killed = 0
    with subprocess.Popen(
        [*command, "--replicates", str(replicates), *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as running:
        root = psutil.Process(running.pid)
        for second in itertools.count():
            if running.poll() is not None:
                break
            workers = sorted(root.children(recursive=True), key=_memory)
            if workers:
                memory.append(_memory(workers[-1]))
            if kill and workers and second == 60:
                workers[-1].kill()
                killed += 1
            time.sleep(1.0)
    if running.returncode:
        raise SystemExit(f"the evaluation ended with exit code {running.returncode}")
    return _children() - before, memory, killed


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _memory(process: psutil.Process) -> int:
    try:
        return process.memory_info().rss
    except psutil.Error:
        return 0


if __name__ == "__main__":
    sys.exit(main())
