"""What all commands share: checks of options, tables on the terminal, and how a command ends."""

import os
import sys
from collections.abc import Callable

from wbc_bench.errors import BenchError

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


def print_table(table) -> None:
    if sys.stdout.isatty():
        from rich.console import Console

        Console().print(table.rich())
    else:
        print(table.markdown())


def run_command(run: Callable[[], None], interrupted: str) -> None:
    """Run a command; exits with 2 on a mistake of the user and with 130, and a remark, when interrupted."""
    try:
        run()
    except BenchError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader went away, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print(f"interrupted: {interrupted}", file=sys.stderr)
        sys.exit(130)
