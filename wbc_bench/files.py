"""Files and folders that are written: whole or not at all, under names that every system takes."""

import contextlib
import errno
import hashlib
import os
import re
import shutil
import time
from pathlib import Path

from wbc_bench.errors import StoreError


def _protocols() -> Path:
    package = Path(__file__).parent
    in_wheel = package / "protocols"
    return in_wheel if in_wheel.is_dir() else package.parent / "protocols"


PROTOCOLS = _protocols()  # released protocols, scripts and studies: a wheel holds them beside the code


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
_TEMPORARY = re.compile(r"\.?\.probe-\d+(\.\d+\.tmp)?|\.publish-\w+")


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is afterwards either whole or not there, even after a power cut.

    Raises: StoreError when the disk is full or the folder cannot be written; nothing is left behind.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
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
        write_atomic(probe, b"probe")
    finally:
        probe.unlink(missing_ok=True)


def _sweep(folder: Path) -> None:
    """Remove temporary files and folders of this package that nobody has touched for STALE seconds."""
    with contextlib.suppress(OSError):  # whoever else sweeps, or a folder of somebody else's
        for path in folder.iterdir():
            if _TEMPORARY.fullmatch(path.name) and time.time() - path.lstat().st_mtime > STALE:
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # network shares cannot sync a folder
            raise
    finally:
        os.close(descriptor)
