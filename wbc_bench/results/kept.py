"""Parts of a report that are not made again, since records, code and files are those of the last time."""

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from wbc_bench.provenance import digest_of_code
from wbc_bench.results.figures.style import STYLE

NOTE = ".report.json"  # beside report.html; without it, everything is made


class _Part(msgspec.Struct, frozen=True):
    inputs: str  # digest of all that the files follow from
    files: dict[str, str]  # path below the report's folder -> SHA-256


class KeptParts:
    """What the last report in a folder consists of, and this one's in the making."""

    def __init__(self, out: Path, made: Path, module: str) -> None:
        """Read the note of the last report; one that is missing or damaged keeps nothing.

        Args:
            out: The folder of the report.
            made: The folder in which this one is made before it is moved there.
            module: The module that makes reports: its code counts, with all that it imports.
        """
        self._out, self._made = out, made
        self._code = digest_of_code(module, STYLE)
        self._now: dict[str, _Part] = {}
        try:
            self._last = msgspec.json.decode((out / NOTE).read_bytes(), type=dict[str, _Part])
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
            self._last = {}

    def part(self, name: str, inputs: Any, make: Callable[[Path], object]) -> None:
        """Take the files of a part from the last report, or make them.

        Args:
            name: The part.
            inputs: All that its files follow from besides the code, as msgspec can encode it.
            make: Writes the files below the folder that it is given.
        """
        digest = _sha256(msgspec.json.encode((self._code, name, inputs), order="deterministic"))
        last = self._last.get(name)
        if last and last.inputs == digest and all(self._is_kept(*file) for file in last.files.items()):
            for path in last.files:
                (self._made / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self._out / path, self._made / path)
            self._now[name] = last
            return
        before = self._files()
        make(self._made)
        new = {path: _sha256((self._made / path).read_bytes()) for path in sorted(self._files() - before)}
        self._now[name] = _Part(digest, new)

    def write(self) -> None:
        """Write the note of this report."""
        (self._made / NOTE).write_bytes(msgspec.json.encode(self._now, order="deterministic"))

    def _files(self) -> set[str]:
        paths = (path for path in self._made.rglob("*") if path.is_file())
        return {path.relative_to(self._made).as_posix() for path in paths}

    def _is_kept(self, path: str, digest: str) -> bool:
        """Whether the file is there unchanged; a note must not name files outside the folder."""
        if Path(path).is_absolute() or ".." in Path(path).parts:
            return False
        try:
            return _sha256((self._out / path).read_bytes()) == digest
        except OSError:
            return False


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
