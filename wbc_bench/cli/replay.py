"""`wbc-bench replay`, `film` and `export-dataset`: episodes of a stored run again."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional

from wbc_bench.cli.common import RESULTS, UsageError, drawing, open_records

if TYPE_CHECKING:
    from wbc_bench.results.store import Run


LARGEST_GRID = 5  # columns or rows: each episode has a renderer of its own, and is 400 pixels wide


@dataclass(frozen=True)
class _Stored:
    name: Annotated[Positional[str], tyro.conf.arg(name="run")]
    """Folder of a stored run, or <protocol>/<controller>/replicate_<k> of the records."""
    results: Path = RESULTS
    """Folder to read the records from."""
    protocol: str | None = None
    """Path of the .toml file of the run's protocol; needed only if that is neither a released one nor kept
    beside the run."""
    controller: str | None = None
    """Controller to run, which is code of yours: module:attribute or file.py:attribute. Needed if the one of
    the record is not installed; a file that a record names is never run for that alone."""

    def _find(self) -> "Run":
        """The run, given by its folder or by its name below the folder of the records."""
        from wbc_bench.results.store import ResultStore

        if (Path(self.name) / "run.json").exists():
            return ResultStore(self.results).find(self.name)
        return open_records(self.results).find(self.name)


@dataclass(frozen=True)
class _Again(_Stored):
    episode: int = tyro.MISSING
    """Index of the episode in its replicate, counted from 0."""


@dataclass(frozen=True)
class Replay(_Again):
    """Run one episode of a stored run again, compare it with its record, and write it to be watched."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("replay.html")
    """Path of the page to write, FILE.html, which needs no network; or FILE.rrd for a recording that the
    viewer of Rerun opens."""

    def run(self) -> None:
        drawing()
        from wbc_bench.files import ensure_file_writable
        from wbc_bench.progress import Progress
        from wbc_bench.viewer.replay import write_html
        from wbc_bench.viewer.rerun import rerun
        from wbc_bench.viewer.rrd import write_rrd

        if self.out.suffix not in (".html", ".rrd"):
            raise UsageError(f"'{self.out}': valid: a file that ends in .html or .rrd")
        ensure_file_writable(self.out)
        run = self._find()
        with Progress("steps") as progress:
            again = rerun(run, self.episode, self.protocol, progress.update, self.controller)
        (write_html if self.out.suffix == ".html" else write_rrd)(again, self.out)
        print(f"{again.title}: {again.stored['outcome']}\n{again.verdict}\n{self.out}")


@dataclass(frozen=True)
class Film(_Again):
    """Run one episode of a stored run again and film it, or draw successive pictures of it side by side."""

    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Path of the film to write, FILE.mp4; no film when not given."""
    strip: Path | None = None
    """Path of the strip of pictures to write, FILE.png, with its caption beside it as FILE.txt; no strip when
    not given."""
    times: tuple[float, ...] | None = None
    """Times since the start of the episode of the strip's pictures [s]; six, evenly over the episode, when
    not given."""
    grid: str | None = None
    """Columns and rows of a film of several episodes side by side, e.g. 3x3; they are --episode and those
    that follow it in the replicate. One episode alone when not given."""

    def run(self) -> None:
        drawing()
        from wbc_bench.files import ensure_file_writable, write_atomic
        from wbc_bench.progress import Progress
        from wbc_bench.viewer.film import strip_caption, strip_of, write_film_of, write_grid_of
        from wbc_bench.viewer.picture import write_png
        from wbc_bench.viewer.rerun import rerun

        if self.out is None and self.strip is None:
            raise UsageError("nothing to write: give -o FILE.mp4, --strip FILE.png or both")
        for path, suffix in ((self.out, ".mp4"), (self.strip, ".png")):
            if path and path.suffix != suffix:
                raise UsageError(f"'{path}': valid: a file that ends in {suffix}")
            if path:
                ensure_file_writable(path)
        columns, rows = _grid_of(self.grid)
        if self.grid and (self.strip or not self.out):
            raise UsageError("--grid makes a film: give -o FILE.mp4, and no --strip")
        run = self._find()
        seen = []
        for episode in range(self.episode, self.episode + columns * rows):
            with Progress("steps") as progress:
                seen.append(rerun(run, episode, self.protocol, progress.update, self.controller))
            print(f"{seen[-1].title}: {seen[-1].stored['outcome']}\n{seen[-1].verdict}")
        again = seen[0]
        if self.out:
            with Progress("pictures") as progress:
                if self.grid:
                    write_grid_of(seen, columns, self.out, progress.update)
                else:
                    write_film_of(again, self.out, progress.update)
            print(self.out)
        if self.strip:
            pixels = strip_of(again, self.times)
            write_png(pixels, self.strip)
            write_atomic(self.strip.with_suffix(".txt"), strip_caption(again, self.times).encode())
            print(self.strip)


def _grid_of(text: str | None) -> tuple[int, int]:
    """Columns and rows. Raises: UsageError."""
    if text is None:
        return 1, 1
    found = re.fullmatch(r"(\d)x(\d)", text, re.ASCII)
    columns, rows = map(int, found.groups()) if found else (0, 0)
    if not (1 <= columns <= LARGEST_GRID and 1 <= rows <= LARGEST_GRID):
        raise UsageError(f"--grid '{text}': valid: COLUMNSxROWS of 1 to {LARGEST_GRID} each, e.g. 3x3")
    return columns, rows


@dataclass(frozen=True)
class ExportDataset(_Stored):
    """Run episodes of a stored run again and write them as a LeRobot dataset (version 3)."""

    episodes: tuple[int, ...] = (0,)
    """Index of each episode in its replicate, counted from 0."""
    video: bool = False
    """Whether to film every frame; needs the extra film, and seconds for each second."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("dataset")
    """Folder to write, which must not exist yet."""

    def run(self) -> None:
        drawing()
        from wbc_bench.errors import StoreError
        from wbc_bench.files import ensure_writable
        from wbc_bench.progress import Progress
        from wbc_bench.viewer.dataset import write_episodes

        if not self.episodes or len(set(self.episodes)) < len(self.episodes):
            raise UsageError("--episodes: valid: at least one index, each once")
        if self.out.exists():
            raise StoreError(f"'{self.out}' exists, valid: a folder that does not exist yet")
        ensure_writable(self.out.parent)
        run = self._find()
        with Progress("steps") as progress:
            seen = write_episodes(
                run, self.episodes, self.out, self.protocol, progress.update, self.controller, self.video
            )
        verified = sum(not again.differences for again in seen)
        for again in seen:
            if again.differences:
                print(f"{again.title}: {again.verdict}")
        print(f"{self.out}: {len(seen)} episodes, {verified} verified against their records")
