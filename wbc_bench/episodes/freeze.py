"""Freezing a protocol into its manifest."""

import hashlib
import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import write_manifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.episodes.targets import Progress
from wbc_bench.errors import ManifestError, StoreError
from wbc_bench.files import PROTOCOLS, ensure_file_writable, real_path, scratch_folder


def freeze(
    protocol: EvalProtocol, path: Path, progress: Progress = lambda done, total: None, workers: int = 1
) -> str:
    """Draw every episode and write `path` and the hash beside it; equal bytes for any number of workers.

    Returns:
        SHA-256 of the manifest.

    Raises:
        ProtocolError: a stratum or a height that cannot be filled.
        ManifestError: the manifest is a released one, or it cannot be written, which is tried first.
    """
    _refuse_released(path)
    try:
        if not path.parent.is_dir():  # the protocol stands there: a folder that is missing is a mistake
            raise StoreError(f"folder '{path.parent}' does not exist")
        ensure_file_writable(path)
    except StoreError as error:
        raise ManifestError(f"manifest '{path}' cannot be written: {error}") from error
    manifest = build_manifest(protocol, progress, workers)
    try:
        with scratch_folder(path.parent) as folder:
            fresh = folder / path.name
            write_manifest(manifest, protocol, fresh)
            sha256 = hashlib.sha256(fresh.read_bytes()).hexdigest()
            note = fresh.with_suffix(".sha256")
            note.write_text(f"{sha256}  {path.name}\n")
            for file in (fresh, note):
                with file.open("rb") as handle:
                    os.fsync(handle.fileno())
            fresh.replace(path)
            note.replace(path.with_suffix(".sha256"))
    except OSError as error:
        raise ManifestError(f"manifest '{path}' cannot be written: {error.strerror or error}") from error
    return sha256


def _refuse_released(path: Path) -> None:
    """Raises: ManifestError, the file is a released manifest: another processor would give it other bytes."""
    if path.exists() and real_path(path).parent == real_path(PROTOCOLS):
        raise ManifestError(
            f"manifest '{path}' is released and never written anew: copy the protocol under another name"
        )


def build_manifest(
    protocol: EvalProtocol, progress: Progress = lambda done, total: None, workers: int = 1
) -> EpisodeManifest:
    """The manifest of a protocol."""
    rows = kind_of(protocol).rows(protocol, progress, workers)
    columns = {}
    for field in fields(EpisodeManifest):
        values = [row[field.name] for row in rows]
        columns[field.name] = np.array(values, dtype=object if isinstance(values[0], str) else None)
    return EpisodeManifest(**columns)
