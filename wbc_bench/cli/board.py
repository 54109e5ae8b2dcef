"""`wbc-bench submit` and `board`: runs as a file to hand over, and such files as one table."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from wbc_bench.cli.common import RESULTS, UsageError, not_negative, open_records, print_table
from wbc_bench.errors import UnknownNameError


@dataclass(frozen=True)
class Submit:
    """Pack the runs of one controller, its card and all digests into one file that others can check."""

    controller: Positional[str]
    """Controller, by the name that its runs were evaluated under."""
    name: str | None = None
    """Name of the row in a table, of letters, digits, '.', '_', '@' and '-'; what the controller calls itself
    when not given."""
    protocols: tuple[str, ...] = ()
    """Names of the protocols whose runs are packed; all that are not sealed when not given."""
    card: Path | None = None
    """File of text about the controller to pack, e.g. the card of a policy; none when not given."""
    results: Path = RESULTS
    """Folder to read the records from."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Path of the file to write, FILE.zip; NAME.zip when not given."""

    def run(self) -> None:
        import hashlib

        from wbc_bench.files import SEALED, ensure_file_writable, folder_name, write_atomic
        from wbc_bench.readers import read_text
        from wbc_bench.results.submission import SUFFIX, SubmissionError, pack

        runs = open_records(self.results).runs()
        known = {run.record.controller for run in runs}
        if self.controller not in known:
            raise UnknownNameError(
                "evaluated controller", self.controller, known, f"runs under {self.results}"
            )
        runs = [run for run in runs if run.record.controller == self.controller]
        evaluated = {run.record.protocol for run in runs}
        for protocol in self.protocols:
            if protocol not in evaluated:
                where = f"--protocols, runs of {self.controller}"
                raise UnknownNameError("evaluated protocol", protocol, evaluated, where)
        wanted = set(self.protocols) or {name for name in evaluated if not name.endswith(SEALED)}
        chosen = [run for run in runs if run.record.protocol in wanted]
        name = self.name or folder_name((chosen or runs)[0].record.controller_name)
        out = self.out or Path(f"{name}{SUFFIX}")
        if out.suffix != SUFFIX:
            raise UsageError(f"'{out}': valid: a file that ends in {SUFFIX}")
        card = "" if self.card is None else read_text(self.card, "card", SubmissionError)
        if f"{Path.home()}/" in card:
            raise SubmissionError(f"card '{self.card}' names your home folder, valid: relative paths alone")
        data = pack(name, chosen, card)
        ensure_file_writable(out)
        write_atomic(out, data)
        print(f"{hashlib.sha256(data).hexdigest()}  {out}")


@dataclass(frozen=True)
class Board:
    """Verify every submission in a folder, and write their tables, figures and page."""

    folder: Positional[Path]
    """Folder of submissions, FILE.zip each."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("board")
    """Folder to write, empty or not there; index.html is its page."""
    protocol: tuple[str, ...] = ()
    """Paths of the .toml files of protocols that are not released, each with its manifest beside it."""
    commitment: tuple[Path, ...] = ()
    """Paths of the commitments of sealed protocols that are not revealed yet."""
    rerun: int = 0
    """Number of episodes of each run that are run again and compared to the last bit."""
    replays: int = 0
    """Number of the worst episodes of each row that are run again and written as pages to watch."""
    controller: tuple[str, ...] = ()
    """Controllers to run submissions by, NAME=SPEC each, which is code of yours; an installed one needs none.
    Code that a submission names is never run for that alone."""

    def run(self) -> None:
        not_negative("--rerun", self.rerun)
        not_negative("--replays", self.replays)
        given = {}
        for text in self.controller:
            name, equals, spec = text.partition("=")
            if not (name and equals and spec):
                raise UsageError(f"--controller {text}: valid: NAME=SPEC, a submission and what to run it by")
            given[name] = spec
        from wbc_bench.board import Checks, write_board
        from wbc_bench.progress import Progress

        checks = Checks(self.protocol, self.commitment, self.rerun, self.replays, given)
        with Progress("steps") as progress:
            page, table = write_board(self.folder, self.out, checks, progress.update)
        print_table(table)
        print(page)
