"""What all commands share: checks of options, tables on the terminal, and how a command ends."""

import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from wbc_bench.errors import BenchError, StoreError

if TYPE_CHECKING:
    from wbc_bench.results.store import ResultStore

RESULTS = Path("wbc-results")  # of one's own runs; the committed ones of a checkout are in `results`
NO_RECORDS = "no records under '{}'; those committed in a checkout are shown with --results results"

# One thread a worker, whatever a library would like: set before numpy is loaded, inherited by workers.
THREADS = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "VECLIB_MAXIMUM")
}


class UsageError(BenchError):
    """An option out of its range."""


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def at_least_one(option: str, value: int) -> None:
    if value < 1:
        raise UsageError(f"{option} {value}: valid: 1 or more")


def not_negative(option: str, value: int) -> None:
    if value < 0:
        raise UsageError(f"{option} {value}: valid: 0 or more")


def check_port(port: int) -> None:
    if not 0 < port < 1 << 16:
        raise UsageError(f"--port {port}: valid: 1 to 65535")


def host(allow_remote: bool) -> str:
    return "0.0.0.0" if allow_remote else "127.0.0.1"


def within(option: str, value: int | None, most: int, what: str) -> int:
    if value is None:
        return most
    if not 1 <= value <= most:
        raise UsageError(f"{option} {value}: valid: 1 to {most} ({what})")
    return value


def open_records(results: Path) -> "ResultStore":
    """Open a folder for a command that reads its records.

    Raises:
        StoreError: It holds none, of whatever kind.
    """
    from wbc_bench.results.store import ResultStore

    kinds = ("runs/*/*/*/run.json", "doors/*/*/*/run.json", "tracks/*/*/*/track.json")
    kinds += ("stress/*/runs/*/*/*/run.json",)
    if not any(next(results.glob(kind), None) for kind in kinds):
        raise StoreError(NO_RECORDS.format(results))
    return ResultStore(results)


def print_table(table) -> None:
    if sys.stdout.isatty():
        from rich.console import Console

        Console().print(table.rich())
    else:
        print(table.markdown())


def run_command(run: Callable[[], None], interrupted: str) -> None:
    """Run a command and make sure that its output is written.

    A mistake of the user and a failure of the system, e.g. a full disk, end with exit code 2 and one line, an
    interruption with 130 and a remark.
    """
    try:
        try:
            run()
        except SystemExit:  # of --help, whose text is still to be written
            sys.stdout.flush()
            raise
        sys.stdout.flush()
    except BenchError as error:
        _fail(str(error))
    except BrokenPipeError:  # the reader went away, e.g. `| head`
        _end_output()
    except OSError as error:
        place = "" if error.filename is None else f"'{error.filename}': "
        _fail(f"{place}{error.strerror or error}")
    except KeyboardInterrupt:
        _end_output()
        print(f"interrupted: {interrupted}", file=sys.stderr)
        sys.exit(130)


def _fail(text: str) -> None:
    _end_output()
    print(f"error: {' '.join(text.split())}", file=sys.stderr)
    sys.exit(2)


def _end_output() -> None:
    """Write what is buffered, or drop it where that fails: Python would try again at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        with contextlib.suppress(OSError):  # an output without a descriptor has nothing to try again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def drawing() -> None:
    """Before MuJoCo is used: it loads the library that MUJOCO_GL names when it is imported.

    Raises: UsageError, it cannot.
    """
    try:
        import mujoco  # noqa: F401
    except (ImportError, AttributeError, RuntimeError) as error:  # the last of a name it does not know
        chosen = os.environ.get("MUJOCO_GL", "")
        raise UsageError(
            f"MuJoCo cannot draw with MUJOCO_GL={chosen} ({error}): install it or unset that"
        ) from error
