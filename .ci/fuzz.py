"""Damage thousands of files and read them: reports tracebacks, hangs, allocations, files written or lost.

    python .ci/fuzz.py --inputs 20000            # every reader in turn, minutes; portions: --first 5000

The trials are those of tests/test_damaged_files.py with other seeds; a failure is repeated by its number:
`--first NUMBER --inputs 1`. Exit code 1 when there was one.
"""

import argparse
import json
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
SLOW = 20.0  # [s] of the processor for one input
HUNG = 600.0  # [s] without an answer, on a machine that has other work as well
LARGE = 1 << 30  # [B] by which the memory of the process may grow at one input


def work(numbers: range) -> None:
    """Do trials in this process; one line of JSON per trial."""
    import pyarrow as pa

    from damaged_readers import READERS, trial

    names = list(READERS)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as scratch:
        for name in names:
            sound = Path(scratch) / name
            sound.mkdir()
            READERS[name].write(sound)
            READERS[name].read(sound)
        print(json.dumps({"begun": True}), flush=True)
        for number in numbers:
            name, begun, before = names[number % len(names)], time.process_time(), _memory(pa)
            done, fault = trial(name, 1_000_000 + number, Path(scratch) / name, Path(scratch) / "damaged")
            row = {"number": number, "reader": name, "done": done, "seconds": time.process_time() - begun}
            row["grown"] = max(0, _memory(pa) - before)
            if fault is not None:
                row["fault"] = _told(fault)
            print(json.dumps(row), flush=True)


def _memory(pa) -> int:
    """The most [B] that this process has used so far, and what arrow has reserved without using it."""
    return max(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, pa.default_memory_pool().max_memory()
    )


def _told(fault: BaseException) -> str:
    trace, place = fault.__traceback__, ""
    while trace is not None:
        place = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{type(fault).__name__} at {place}: {' '.join(str(fault).split())[:300]}"


def rows(numbers: range):
    """Rows of the trials of other processes; one that hangs or dies is replaced from the next trial on."""
    first = numbers.start
    while first < numbers.stop:
        words = [sys.executable, __file__, "--worker", "--first", str(first)]
        words += ["--inputs", str(numbers.stop - first)]
        paths = [ROOT / "tests" / "helpers", ROOT, ROOT / "baselines"]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "OMP_NUM_THREADS": "1"}
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=env) as process:
            assert process.stdout is not None
            begun = False
            while True:
                ready, _, _ = select.select([process.stdout], [], [], HUNG)
                line = process.stdout.readline() if ready else b""
                if not line:
                    break
                try:
                    row = json.loads(line)
                except ValueError:  # a reader, or a library below it, has printed something
                    yield {
                        "number": first,
                        "reader": "?",
                        "seconds": 0.0,
                        "grown": 0,
                        "fault": f"printed {line!r}",
                    }
                    continue
                begun = begun or "begun" in row
                if "number" in row:
                    yield row
                    first = row["number"] + 1
            process.kill()
        if not begun:
            raise SystemExit("the worker did not begin")
        if first < numbers.stop:
            yield {"number": first, "reader": "?", "seconds": 0.0, "grown": 0, "fault": "hung or died"}
            first += 1


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.inputs)
    if options.worker:
        work(numbers)
        return 0
    faults: Counter[str] = Counter()
    for row in rows(numbers):
        kinds = [
            kind
            for kind, bad in (
                (
                    "traceback",
                    "fault" in row and "reading wrote" not in row["fault"] and row["reader"] != "?",
                ),
                ("hang or crash", row["reader"] == "?" or row["seconds"] > SLOW),
                ("allocation", row["grown"] > LARGE),
                ("files written or lost", "reading wrote" in row.get("fault", "")),
            )
            if bad
        ]
        faults.update(kinds)
        if kinds:
            print(", ".join(kinds), json.dumps(row), flush=True)
    kinds = ("traceback", "hang or crash", "allocation", "files written or lost")
    print(f"{len(numbers)} inputs: " + ", ".join(f"{kind} {faults[kind]}" for kind in kinds))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
