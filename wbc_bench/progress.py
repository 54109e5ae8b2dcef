"""How far a long computation is: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from types import TracebackType

LINE_PERIOD = 10.0  # [s] between lines where there is no terminal


class Progress:
    """Units done, units per second and time left, on stderr."""

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.done = self.total = 0
        self._start = self._last = time.monotonic()
        self._bar = _bar() if sys.stderr.isatty() else None

    def __enter__(self) -> "Progress":
        if self._bar:
            self._task = self._bar.add_task("", total=None, rate="", left="")
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ):
        if self._bar:
            self._bar.stop()
        elif kind is None and self.done:
            self._line(f"{time.monotonic() - self._start:.1f} s")

    def update(self, done: int, total: int, what: str = "", left: str | None = None) -> None:
        """`done` of `total` units are done, the latest of `what`.

        `left` says what is known of the time left; by the units per second so far when not given, which is
        right only where all units take equally long.
        """
        first = self.done == 0
        self.done, self.total = done, total
        now = time.monotonic()
        rate = self._rate(now)
        if left is None:
            # the first units also waited for processes to start: they say little of the others
            left = f"{(total - done) / rate:.0f} s left" if rate and not first else "time left unknown"
        if self._bar:
            shown = f"{rate:.1f} {self.unit}/s"
            self._bar.update(self._task, completed=done, total=total, description=what, rate=shown, left=left)
        elif (first and 0 < done < total) or now - self._last >= LINE_PERIOD:
            self._last = now
            self._line(f"{left}{', ' if what else ''}{what}")

    def _rate(self, now: float) -> float:
        return self.done / max(now - self._start, 1e-9)  # [1/s]

    def _line(self, tail: str) -> None:
        rate = self._rate(time.monotonic())
        print(f"{self.done}/{self.total} {self.unit}, {rate:.1f}/s, {tail}", file=sys.stderr, flush=True)


def _bar():
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    return Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[left]}"),
        console=Console(stderr=True),
    )
