"""Files and folders that are written: whole or not at all, under names that every system takes."""

import contextlib
import errno
import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from wbc_bench.errors import StoreError


def _protocols() -> Path:
    package = Path(__file__).parent
    in_wheel = package / "protocols"
    return in_wheel if in_wheel.is_dir() else package.parent / "protocols"


PROTOCOLS = _protocols()  # released protocols, scripts and studies: a wheel holds them beside the code
SEALED = "_sealed"  # end of the name of a protocol whose episodes are not published yet


LONGEST_NAME = 120  # characters of a folder's name; file systems take 255 bytes, temporary names are longer


def folder_name(name: str) -> str:
    """A protocol or controller spec as a folder name; a long one is cut and ends in a part of its digest.

    Raises: StoreError, nothing of the name can stand in a folder's.
    """
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "._@-") else "-" for c in name).strip("-.")
    if not plain:
        raise StoreError(f"'{name}' cannot name a folder, valid: at least one ASCII letter or digit")
    if len(plain) > LONGEST_NAME:
        plain = f"{plain[:LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return plain


def is_folder_name(name: str) -> bool:
    """Whether a name is a folder's as it stands, so that whoever has the name finds the folder, and back."""
    plain = re.fullmatch(r"[\w@]([\w.@-]*[\w@])?", name, re.ASCII)
    return plain is not None and len(name) <= LONGEST_NAME


STALE = 3600.0  # [s] what a temporary file is written in is a minute at most
_PROBE = re.compile(r"\.probe-\d+|\.\.probe-(\d+)\.\1\.tmp")
_PROBED = b"probe"
_SCRATCH = ".publish-"
_MARK, _MARKED = ".wbc-bench", b"temporary folder of wbc-bench; it may be removed\n"


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is afterwards either whole or not there, even after a power cut.

    Raises: StoreError when the disk is full or the folder cannot be written; nothing is left behind.
    """
    part = temporary(path)
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):  # where not even that is possible, it was never made
            part.unlink()
        raise StoreError(
            f"cannot write '{path}': {error.strerror}; whatever was finished before is kept"
        ) from error


def real_path(path: Path | str) -> Path:
    """Where a path leads through its links; unlike `Path.resolve`, links in a circle are no error."""
    return Path(os.path.realpath(path))


def temporary(path: Path) -> Path:
    """What a file is called beside its place until it is whole; a name of any length leaves room for that."""
    return path.with_name(f".{path.name[: LONGEST_NAME // 2]}.{os.getpid()}.tmp")


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """Turn what the system raises where something is written into one line. Raises: StoreError."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot write to '{place}': {error.strerror or error}") from error


@contextlib.contextmanager
def made_whole(out: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Several files, of which none is replaced before all are made.

    Yields:
        An empty folder to make them in; they are moved below `out` at the end. And a list, which then holds
        where they stand, in order.

    Raises:
        StoreError: They cannot be written; what was there before is kept.
    """
    moved: list[Path] = []
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with scratch_folder(out) as made:
            yield made, moved
            for path in sorted(made.rglob("*")):
                if path.is_file():
                    place = out / path.relative_to(made)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    moved.append(path.replace(place))


def ensure_file_writable(path: Path) -> None:
    """Check that a file can be written, before minutes are spent on its content; see `ensure_writable`.

    Raises: StoreError, its folder cannot be written, its name is too long, or it is there and no file.
    """
    ensure_writable(path.parent)
    with writing(path):
        if path.exists() and not path.is_file():  # a device would be replaced
            raise StoreError(f"'{path}' is a {'folder' if path.is_dir() else 'device'}, valid: a file")


def ensure_writable(folder: Path) -> None:
    """Create a folder and write to it, before minutes are spent on what cannot be kept.

    What a killed process left there of this package's temporary files is removed.

    Raises: StoreError when that fails; permission bits alone do not tell (root, read-only mounts).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"folder '{folder}' cannot be written: {error.strerror}") from error
    _sweep(folder)
    probe = folder / f".probe-{os.getpid()}"
    try:
        write_atomic(probe, _PROBED)
    finally:
        probe.unlink(missing_ok=True)


@contextlib.contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """An empty folder below `parent`, on the same file system, that is removed in the end.

    What a killed process left there of this package's temporary files is removed first.

    Raises: OSError when it cannot be made.
    """
    _sweep(parent)
    with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=parent) as folder:
        Path(folder, _MARK).write_bytes(_MARKED)
        inner = Path(folder, "made")
        inner.mkdir()
        yield inner


def _sweep(folder: Path) -> None:
    """Remove temporary files and folders of this package that nobody has touched for STALE seconds.

    The folder may be any of the user's, whose files may have such names too: the content decides.
    """
    paths = []
    with contextlib.suppress(OSError):  # a folder that cannot be listed
        paths = list(folder.iterdir())
    for path in paths:
        with contextlib.suppress(OSError):  # whoever else sweeps, or a file of somebody else's
            if _is_ours(path) and time.time() - path.lstat().st_mtime > STALE:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _is_ours(path: Path) -> bool:
    """Whether this package made a temporary file or folder; of anything in doubt it did not."""
    if path.is_symlink():
        return False
    if _PROBE.fullmatch(path.name):
        return (
            path.is_file() and path.stat().st_size <= len(_PROBED) and _PROBED.startswith(path.read_bytes())
        )
    mark = path / _MARK
    marked = path.name.startswith(_SCRATCH) and path.is_dir() and mark.is_file()
    return marked and mark.stat().st_size == len(_MARKED) and mark.read_bytes() == _MARKED


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # network shares cannot sync a folder
            raise
    finally:
        os.close(descriptor)
