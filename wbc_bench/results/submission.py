"""A submission: the runs of one controller, its card and all digests, in one file that others can check.

The file is a zip archive without compression and with fixed dates, so that equal records give equal bytes,
and what it holds can never be larger than the file. Reading one runs no code of it.
"""

import hashlib
import io
import re
import stat
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pandas as pd
import pyarrow as pa

from wbc_bench.errors import BenchError, StoreError
from wbc_bench.files import SEALED, folder_name, is_folder_name
from wbc_bench.readers import LARGEST_FILE, decode_json, read_bytes, reading
from wbc_bench.results.analysis import collect_all
from wbc_bench.results.records import parquet_of
from wbc_bench.results.store import ResultStore, Run, RunRecord, identity

SUFFIX = ".zip"
MANIFEST, CARD = "submission.json", "card.txt"
MOST_FILES = 2000  # two of each run, of which a protocol has as many as replicates
LARGEST_CARD = 64 << 10  # [B]
_DATE = (1980, 1, 1, 0, 0, 0)  # the first that the format knows
_RUN_FILE = re.compile(r"runs/[\w.@-]+/[\w.@-]+/replicate_\d{1,6}/(run\.json|episodes\.parquet)", re.ASCII)
# the folders of a path in a spec that stands outside the working folder: an absolute one, ~/ or ../
_FOLDERS = re.compile(r"(?<![^:?&=])(?:[A-Za-z]:(?=[/\\]))?(?=[/\\~]|\.\.[/\\])[^:?&=]*[/\\]")

Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class SubmissionError(BenchError):
    """A submission that cannot be made, or is damaged, altered or not what it says."""


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the manifest."""


class ProtocolDigests(_Part, frozen=True):
    """The episodes that the runs of one protocol met."""

    protocol_digest: Digest
    manifest_sha256: Digest  # of a sealed set: the hash that its commitment has published
    sealed: bool


class ControllerCard(_Part, frozen=True):
    """What the records say of the controller."""

    controller: str  # the spec, without folders outside the working folder
    name: str  # what it calls itself
    source: str
    signals: list[str]
    commands: list[str]
    digests: dict[str, Digest]  # controller as it met a replicate -> of its code and files


class Manifest(_Part, frozen=True):
    """What a submission holds."""

    format: Literal[1]
    name: str  # of its row
    card: ControllerCard
    protocols: dict[str, ProtocolDigests]
    files: dict[str, Digest]  # name in the archive -> SHA-256


@dataclass(frozen=True)
class SubmittedRun:
    """A run of a submission as tables take it."""

    record: RunRecord
    table: pa.Table
    path: Path  # of the unpacked run

    def episodes(self) -> pd.DataFrame:
        """One row per episode."""
        return self.table.to_pandas()


@dataclass(frozen=True)
class Submission:
    """A submission that agrees with its own hashes."""

    path: Path
    sha256: str  # of the file
    manifest: Manifest
    runs: tuple[SubmittedRun, ...]
    card: str  # the text that came with it, "" without one

    @property
    def name(self) -> str:
        """The name of its row."""
        return self.manifest.name


def public_spec(spec: str) -> str:
    """A spec that tells nothing of its user: paths lose folders outside the working one, addresses go."""
    return "remote" if spec.startswith("remote:") else _FOLDERS.sub("", spec)


def pack(name: str, runs: Sequence[Run], card: str = "") -> bytes:
    """The bytes of a submission; equal runs give equal bytes.

    Args:
        name: The name of its row in tables, which is also that of a folder.
        runs: Finished runs of one controller.
        card: A text about the controller, e.g. the card of a policy.

    Raises:
        SubmissionError: The name cannot be a folder's, the card is too long, or the runs are of several
            controllers or of several versions of one.
        StoreError: Episodes are not those of their record.
    """
    files: dict[str, bytes] = {}
    records = []
    for run in runs:
        spec = public_spec(run.record.controller)
        resolved = run.record.resolved_controller
        record = msgspec.structs.replace(
            run.record, resolved_controller=None if resolved is None else public_spec(resolved)
        )
        if spec == record.controller:
            run.table()  # checks it
            data = read_bytes(run.path / "episodes.parquet", "episodes", StoreError)
        else:
            record, data = renamed(record, run.table(), spec)
        folder = f"runs/{folder_name(record.protocol)}/{folder_name(spec)}/replicate_{record.replicate}"
        files[f"{folder}/run.json"] = msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n"
        files[f"{folder}/episodes.parquet"] = data
        records.append(record)
    if card:
        files[CARD] = card.encode()
    manifest = _manifest(name, records, {path: _sha256(data) for path, data in files.items()})
    _check_manifest(manifest, card)
    files[MANIFEST] = msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n"
    return _archive(files)


def renamed(record: RunRecord, table: pa.Table, spec: str) -> tuple[RunRecord, bytes]:
    """A record and its episodes under another spec; the values are the same."""
    record = msgspec.structs.replace(record, controller=spec)
    data, sha256 = parquet_of(table.replace_schema_metadata(identity(record)))
    return msgspec.structs.replace(record, episodes_sha256=sha256), data


def _archive(files: Mapping[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, _DATE)
            info.create_system, info.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            archive.writestr(info, files[name])
    data = sink.getvalue()
    if len(data) > LARGEST_FILE:
        raise SubmissionError(
            f"the submission would have {len(data)} bytes, valid: at most {LARGEST_FILE}; submit fewer "
            f"protocols"
        )
    return data


def read_submission(path: Path, folder: Path) -> Submission:
    """Read a submission, check it against all of its hashes, and unpack its runs into `folder`.

    Args:
        path: The file.
        folder: An empty folder that is the caller's; nothing else is written to.

    Raises:
        SubmissionError: It is damaged, altered, not made by `pack`, or contradicts itself.
    """
    if path.is_symlink():
        raise SubmissionError(f"submission '{path}' is a link, valid: a file")
    data = read_bytes(path, "submission", SubmissionError)
    with reading("submission", path, "a zip archive as `submit` writes it", SubmissionError):
        files = _files(data, path)
        manifest = decode_json(files.pop(MANIFEST), path, Manifest, "submission", SubmissionError)
    for name in sorted(files.keys() | manifest.files.keys()):
        if name not in files or name not in manifest.files:
            where = "archive" if name not in files else "manifest"
            raise SubmissionError(f"submission '{path}': '{name[:200]}' is not in its {where}")
        if _sha256(files[name]) != manifest.files[name]:
            raise SubmissionError(
                f"submission '{path}': '{name}' was changed, its sha256 is {_sha256(files[name])[:16]}..., "
                f"the "
                f"manifest says {manifest.files[name][:16]}..."
            )
    with reading("submission", path, "a card of UTF-8 text", SubmissionError):
        card = files.pop(CARD, b"").decode()
    for name, content in files.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
    try:
        runs = tuple(SubmittedRun(run.record, run.table(), run.path) for run in ResultStore(folder).runs())
        collect_all(runs)
        if 2 * len(runs) != len(files):
            raise SubmissionError("a run lacks its record or its episodes")
        records = [run.record for run in runs]
        for record in records:
            if public_spec(record.controller) != record.controller:
                raise SubmissionError(f"controller '{record.controller}' has a path, valid: one without")
        _check_manifest(manifest, card)
        if _manifest(manifest.name, records, manifest.files) != manifest:
            raise SubmissionError(f"{MANIFEST} says other than the records do")
    except BenchError as error:
        text = str(error).replace(f"{folder}/", "")  # the reader of the line knows the archive alone
        raise SubmissionError(f"submission '{path}': {text}") from error
    return Submission(path, _sha256(data), manifest, runs, card)


def _files(data: bytes, path: Path) -> dict[str, bytes]:
    """Name -> content of an archive, if all of it is such as `_archive` writes.

    Raises: SubmissionError, and whatever the decoder raises.
    """

    def refuse(problem: str, valid: str) -> None:
        raise SubmissionError(f"submission '{path}': {problem}, valid: {valid}")

    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        if len(entries) > MOST_FILES:
            refuse(f"{len(entries)} files", f"at most {MOST_FILES}")
        for entry in entries:
            name = entry.filename[:200]
            if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG):
                refuse(f"'{name}' is a link or no file", "files alone")
            if entry.filename not in (MANIFEST, CARD) and not _RUN_FILE.fullmatch(entry.filename):
                refuse(f"'{name}' is no name of a submission's file", f"{MANIFEST}, {CARD} and files of runs")
            if any(part.startswith(".") for part in entry.filename.split("/")):
                refuse(f"'{name}' is no name of a submission's file", "names that begin with no dot")
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
                refuse(f"'{name}' is compressed", "files as they are, so that none can be larger than it")
            if entry.flag_bits & 1:
                refuse(f"'{name}' is encrypted", "files as they are")
        names = [entry.filename for entry in entries]
        if len(set(names)) < len(names):
            refuse("two files of one name", "each once")
        if sum(entry.file_size for entry in entries) > len(data):
            refuse("files that overlap", "each by itself")
        if MANIFEST not in names:
            refuse(f"no {MANIFEST}", "an archive as `submit` writes it")
        return {name: archive.read(name) for name in names}


def _check_manifest(manifest: Manifest, card: str) -> None:
    """Raises: SubmissionError, the name or the card is none."""
    if not is_folder_name(manifest.name):
        raise SubmissionError(
            f"name '{manifest.name[:200]}', valid: letters, digits, '.', '_', '@' and '-', as of a folder"
        )
    if len(card.encode()) > LARGEST_CARD:
        raise SubmissionError(f"the card has {len(card.encode())} bytes, valid: at most {LARGEST_CARD}")


def _manifest(name: str, records: Sequence[RunRecord], files: Mapping[str, str]) -> Manifest:
    """What follows from records. Raises: SubmissionError, they are of more than one controller or version."""
    if not records:
        raise SubmissionError("no run, valid: at least one")
    first = records[0]
    for record in records:
        for field in ("controller", "controller_name", "signals", "commands"):
            if getattr(record, field) != getattr(first, field):
                raise SubmissionError(
                    f"runs of two controllers: {field} is {getattr(first, field)} and "
                    f"{getattr(record, field)}, "
                    "valid: one"
                )
    digests: dict[str, str] = {}
    software: dict[tuple[str, str], str] = {}
    protocols: dict[str, ProtocolDigests] = {}
    for record in records:
        resolved, where = record.resolved_controller, f"{record.protocol}, replicate {record.replicate}"
        if resolved is None or record.controller_sha256 is None:
            raise SubmissionError(
                f"the record of {where} has no digest of its controller, as those before 0.1.0: evaluate it "
                f"again"
            )
        met = ProtocolDigests(
            record.protocol_digest, record.manifest_sha256, record.protocol.endswith(SEALED)
        )
        code = software.setdefault((record.protocol, resolved), record.software_sha256)
        same = {
            f"digest of controller '{resolved}'": digests.setdefault(resolved, record.controller_sha256)
            == record.controller_sha256,
            f"digest of the software of '{resolved}'": code == record.software_sha256,
            "protocol or its manifest": protocols.setdefault(record.protocol, met) == met,
        }
        for what, agrees in same.items():
            if not agrees:
                raise SubmissionError(
                    f"the {what} is another in {where} than in a run before it, valid: one a row; evaluate "
                    f"one "
                    "of them again with --overwrite"
                )
    return Manifest(
        1,
        name,
        ControllerCard(
            *(first.controller, first.controller_name, first.source),
            *(sorted(first.signals), sorted(first.commands), digests),
        ),
        protocols,
        dict(sorted(files.items())),
    )


def refuse_two_of_a_name(submissions: Iterable[Submission]) -> None:
    """Raises: SubmissionError, two submissions would be one row."""
    seen: dict[str, Path] = {}
    for submission in submissions:
        known = seen.setdefault(submission.name.lower(), submission.path)
        if known != submission.path:
            raise SubmissionError(
                f"submissions '{known}' and '{submission.path}' are both called '{submission.name}', valid: "
                f"a "
                "name of its own for each; make one again with --name"
            )


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
