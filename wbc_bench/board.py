"""A board: submissions of several people, verified, as one table with figures and a page.

Nothing of a submission is imported or run: where episodes are run again, the controller is one that is
installed or that the caller names.
"""

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from wbc_bench import provenance
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol, protocol_names
from wbc_bench.episodes.sealed import Commitment, SealError, read_commitment
from wbc_bench.errors import BenchError, StoreError, UnknownNameError
from wbc_bench.files import SEALED, ensure_writable, scratch_folder, write_atomic
from wbc_bench.installed import is_installed
from wbc_bench.outcomes import Outcome, SuccessRule
from wbc_bench.publish import publish
from wbc_bench.readers import read_json
from wbc_bench.registry import load_controller, spec_of_replicate
from wbc_bench.results.analysis import collect_all, column
from wbc_bench.results.board_page import Again, board_html, submission_table, worst_of_all
from wbc_bench.results.gallery import replay_path
from wbc_bench.results.records import write_record
from wbc_bench.results.store import ResultStore, Run, RunRecord
from wbc_bench.results.study import Study, released_studies
from wbc_bench.results.submission import (
    SUFFIX,
    Submission,
    SubmittedRun,
    read_submission,
    refuse_two_of_a_name,
    renamed,
)
from wbc_bench.results.table import Table
from wbc_bench.robot import load_robot
from wbc_bench.viewer.replay import write_html
from wbc_bench.viewer.rerun import ShowProgress, rerun

# an installed controller by names alone: with a path or an address, a record would choose what is read
_SHIPPED = re.compile(r"\w+(:[\w@-]+)?", re.ASCII)
_COLUMNS = ("stratum", "condition", "orientation")  # of episodes, as the manifest has them


class BoardError(BenchError):
    """Submissions that cannot stand on one board."""


class Known(NamedTuple):
    """A protocol of a board; of a sealed one that is not revealed, the hash of its manifest alone."""

    manifest_sha256: str
    path: Path | None = None  # of the protocol
    protocol: EvalProtocol | None = None
    manifest: EpisodeManifest | None = None


@dataclass(frozen=True)
class Checks:
    """How submissions are checked, and what is shown of them."""

    protocols: tuple[str, ...] = ()  # files of protocols that are not released
    commitments: tuple[Path, ...] = ()  # of sealed sets that are not revealed
    rerun: int = 0  # episodes of each run
    replays: int = 0  # worst episodes of each row
    controllers: Mapping[str, str] = field(default_factory=dict)  # name of a submission -> spec to run

    def spec(self, name: str, record: RunRecord) -> str | None:
        """What to run episodes of a submission by; None where its code is neither given nor shipped."""
        own = record.controller
        return self.controllers.get(name, own if is_installed(own) and _SHIPPED.fullmatch(own) else None)


def write_board(
    folder: Path, out: Path, checks: Checks | None = None, progress: ShowProgress = lambda *_: None
) -> tuple[Path, Table]:
    """Verify every submission in a folder, and write their tables, figures and page to a new folder.

    Args:
        folder: The folder of submissions, FILE.zip each.
        out: The folder to write; it must be empty or not there. It is written whole or not at all.
        checks: See `Checks`.
        progress: Told of every episode that is run again.

    Returns:
        The page, and the table of the submissions.

    Raises:
        SubmissionError: One is damaged, altered or no submission.
        BoardError: There is none, they were evaluated on other episodes than those of the protocol here, an
            episode that was run again ended otherwise, or `out` holds files.
        BenchError: See `find_protocol`, `read_manifest`, `read_commitment`, `load_controller`, `publish`.
    """
    checks = checks or Checks()
    paths = sorted(path for path in folder.glob(f"*{SUFFIX}"))
    if not paths:
        raise BoardError(
            f"no submission in '{folder}', valid: files that `submit` wrote, which end in {SUFFIX}"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BoardError(f"'{out}' holds files already, valid: a folder that is empty or not there")
    with tempfile.TemporaryDirectory() as scratch:
        submissions = [read_submission(path, Path(scratch, str(k))) for k, path in enumerate(paths)]
        refuse_two_of_a_name(submissions)
        submissions.sort(key=lambda submission: submission.name)
        names = [submission.name for submission in submissions]
        for name in checks.controllers:
            if name not in names:
                raise UnknownNameError("submission", name, names, "--controller")
        known = _known_protocols(submissions, checks)
        for submission in submissions:
            for run in submission.runs:
                _check_run(submission, run, known)
        again = {one.name: _run_again(one, known, checks, progress) for one in submissions}
        ensure_writable(out.absolute().parent)
        with scratch_folder(out.absolute().parent) as made:
            board = made / "board"
            _unpack(submissions, board)
            _write_replays(submissions, known, checks, board, progress)
            store = ResultStore(board)
            own = {protocol: Study(protocol, protocol) for protocol in known}
            own |= {study.name: Study(study.name, study.protocol) for study in released_studies()}
            publish(store, board, studies=list(own.values()))
            evaluated = collect_all(store.runs())
            table = submission_table(submissions, again)
            table.write(board / "tables")
            sizes = {name: _size(one) for name, one in known.items() if name in evaluated}
            write_atomic(
                board / "index.html", board_html(table, submissions, evaluated, sizes, board).encode()
            )
            try:
                board.replace(out)  # an empty folder gives way
            except OSError as error:
                raise StoreError(f"cannot write '{out}': {error.strerror}") from error
    return out / "index.html", table


def _known_protocols(submissions: Sequence[Submission], checks: Checks) -> dict[str, Known]:
    """Name -> every protocol that the submissions were evaluated under.

    Raises: BoardError, one is neither released nor given.
    """
    given = {protocol.name: str(path) for protocol, path in map(find_protocol, checks.protocols)}
    sealed = {}
    for path in checks.commitments:
        public = read_json(path, Commitment, "commitment", SealError).protocol
        commitment, _ = read_commitment(path, given.get(public))
        sealed[public + SEALED] = commitment.manifest_sha256
    found: dict[str, Known] = {}
    for submission in submissions:
        for name in submission.manifest.protocols:
            if name in found:
                continue
            if name in given or name in protocol_names():
                protocol, path = find_protocol(given.get(name, name))
                manifest, sha256 = read_manifest(protocol, manifest_path(path))
                found[name] = Known(sha256, path, protocol, manifest)
            elif name in sealed:
                found[name] = Known(sealed[name])
            else:
                option = "--commitment" if name.endswith(SEALED) else "--protocol"
                valid = ", ".join(sorted({*protocol_names(), *given, *sealed}))
                raise BoardError(
                    f"submission '{submission.path}' was evaluated under '{name}', valid: {valid}; name its "
                    f"file "
                    f"with {option}"
                )
    return found


def _check_run(submission: Submission, run: SubmittedRun, known: Mapping[str, Known]) -> None:
    """Raises: BoardError, the run is not of the protocol's episodes, or its rows contradict the protocol."""
    record, of = run.record, known[run.record.protocol]
    where = f"submission '{submission.path}', {record.protocol}, replicate {record.replicate}"
    digests = [("manifest sha256", record.manifest_sha256, of.manifest_sha256)]
    if of.protocol:
        digests.insert(0, ("protocol digest", record.protocol_digest, of.protocol.digest))
    for what, there, here in digests:
        if there != here:
            raise BoardError(f"{where}: its {what} is {there[:16]}..., that of the board is {here[:16]}...")
    if of.protocol is None or of.manifest is None:
        return
    success, horizon = of.protocol.success, of.protocol.episodes.horizon
    if record.rule != SuccessRule(success.position, success.orientation, success.window, horizon):
        raise BoardError(f"{where}: its rule of success is not that of the protocol")
    rows, episodes = of.manifest.of_replicate(record.replicate, record.requested), run.episodes()
    expected = {name: getattr(rows, name) for name in ("episode", *_COLUMNS)}
    expected |= {
        "height": rows.height,
        "target_x": rows.target_pos_w[:, 0],
        "target_y": rows.target_pos_w[:, 1],
    }
    for name, values in expected.items():
        if not np.array_equal(np.asarray(episodes[name]), values):
            raise BoardError(f"{where}: column {name} is not that of the protocol's manifest")
    good = np.asarray(episodes["outcome"] == Outcome.SUCCESS, dtype=bool)
    for name, limit in (("position_error", success.position), ("orientation_error", success.orientation)):
        if not (column(episodes, name)[good] < limit).all():
            raise BoardError(
                f"{where}: a success has a {name.replace('_', ' ')} beyond the tolerance {limit:g}"
            )


def _run_again(
    submission: Submission, known: Mapping[str, Known], checks: Checks, progress: ShowProgress
) -> Again:
    """Run a sample of every run again; its hash decides which episodes.

    Raises: BoardError, one has other values though software and processor are those of the record.
    """
    tried = equal = missing = 0
    for run in submission.runs if checks.rerun else ():
        record, of = run.record, known[run.record.protocol]
        spec = checks.spec(submission.name, record)
        if spec is None or of.path is None or of.protocol is None:
            missing += 1
            continue
        rng = np.random.default_rng(int(record.episodes_sha256[:15], 16))
        count = min(checks.rerun, record.completed)
        for k in np.sort(rng.choice(record.completed, count, replace=False)):
            episode = int(run.table["episode"][int(k)].as_py())
            again = rerun(Run(run.path, record), episode, str(of.path), progress, spec)
            tried += 1
            equal += not again.differences
            if again.differences and _same_software(spec, of.protocol, record):
                raise BoardError(
                    f"submission '{submission.path}', {record.protocol}, replicate {record.replicate}, "
                    f"episode "
                    f"{episode}, run again: {again.verdict}"
                )
    return Again(tried, equal, missing)


def _same_software(spec: str, protocol: EvalProtocol, record: RunRecord) -> bool:
    """Whether the bits of a record can be asked for: the code, packages and processor are those here."""
    controller = load_controller(spec_of_replicate(spec, record.replicate), load_robot(protocol.robot))
    same_processor = record.machine.get("processor") == provenance.machine().get("processor")
    return same_processor and record.software_sha256 == provenance.software(controller).digest


def _unpack(submissions: Sequence[Submission], board: Path) -> None:
    """Write the runs as those of a store, each under the name of its submission."""
    for submission in submissions:
        for run in submission.runs:
            record, data = renamed(run.record, run.table, submission.name)
            record = msgspec.structs.replace(record, controller_name=submission.name)
            path = ResultStore(board).run_path(record.protocol, record.controller, record.replicate)
            write_record(path / "run.json", record, path / "episodes.parquet", data)


def _write_replays(
    submissions: Sequence[Submission],
    known: Mapping[str, Known],
    checks: Checks,
    board: Path,
    progress: ShowProgress,
) -> None:
    """Write the worst episodes of every row as pages, where its controller is given or shipped."""
    for submission in submissions if checks.replays else ():
        for protocol, methods in collect_all(submission.runs).items():
            path = known[protocol].path
            for row in worst_of_all(next(iter(methods.values())), checks.replays):
                run = next(
                    r
                    for r in submission.runs
                    if (r.record.protocol, r.record.replicate) == (protocol, row[0])
                )
                spec = checks.spec(submission.name, run.record)
                if spec is not None and path is not None:
                    page = board / replay_path(protocol, submission.name, *row)
                    page.parent.mkdir(parents=True, exist_ok=True)
                    again = rerun(Run(run.path, run.record), row[1], str(path), progress, spec)
                    write_html(again, page)


def _size(known: Known) -> int | None:
    """Episodes of a protocol, where its file is at hand."""
    return None if known.manifest is None else len(known.manifest)
