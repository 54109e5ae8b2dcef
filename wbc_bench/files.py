"""Files and folders that are written: whole or not at all, under names that every system takes."""

import contextlib
import os
from pathlib import Path

from wbc_bench.errors import StoreError


def _protocols() -> Path:
    package = Path(__file__).parent
    in_wheel = package / "protocols"
    return in_wheel if in_wheel.is_dir() else package.parent / "protocols"


PROTOCOLS = _protocols()  # released protocols, scripts and studies: a wheel holds them beside the code


def folder_name(name: str) -> str:
    """A protocol or controller spec as a folder name."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "._@-") else "-" for c in name).strip("-.")


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

    Raises: StoreError when that fails; permission bits alone do not tell (root, read-only mounts).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"folder '{folder}' cannot be written: {error.strerror}") from error
    probe = folder / f".probe-{os.getpid()}"
    write_atomic(probe, b"probe")
    probe.unlink()


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
