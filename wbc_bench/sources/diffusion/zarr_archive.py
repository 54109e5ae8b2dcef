"""Arrays of a zip of zarr version 2; what they will take is checked before anything is unpacked.

A few kilobytes can claim to be gigabytes, in the zip as in the arrays inside. So only what UMI's tools write
is read: plain numbers, chunks as they are or packed by Blosc, no filters (one of them runs code of the file).
"""

import hashlib
import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError, missing_extra
from wbc_bench.readers import reading

Array = NDArray[np.float64]
KIND = "demonstrations"
MAX_ROWS = 1_000_000  # of an array: 5.5 h of control steps at 50 Hz
MAX_CHUNKS = 100_000  # of an array
MAX_ENTRY = 1 << 20  # [bytes] of a description in JSON
MAX_UNPACKED = 512 << 20  # [bytes] of all entries of the zip that are read; a million steps take 140 MB
BLOSC_HEADER = 16  # [bytes]; bytes 4 to 7 are the size when unpacked. Source: c-blosc, README_CHUNK_FORMAT


class Archive(NamedTuple):
    """What was read of a file."""

    arrays: dict[str, Array]
    attributes: dict[str, Any]  # of the root
    sha256: str


class _Compressor(msgspec.Struct):
    id: Literal["blosc"]


class _Description(msgspec.Struct):
    """An array as its .zarray says. Source: zarr storage specification version 2, section Metadata."""

    zarr_format: Literal[2]
    shape: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]
    chunks: tuple[Annotated[int, msgspec.Meta(ge=1)], ...]
    dtype: str
    compressor: _Compressor | None
    filters: None

    @property
    def chunk_bytes(self) -> int:
        """Of every chunk when unpacked; those at an edge are padded."""
        return math.prod(self.chunks) * np.dtype(self.dtype).itemsize


def zarr_module() -> Any:
    """Zarr, which the extra `diffusion` installs. Raises: SourceError."""
    try:
        import zarr
        import zarr.storage
    except ImportError as error:
        raise SourceError(missing_extra("a file of demonstrations", "diffusion", error)) from error
    return zarr


def read_archive(path: Path, wanted: Mapping[str, int], optional: frozenset[str] = frozenset()) -> Archive:
    """Arrays of a file; whatever else it holds is neither unpacked nor checked.

    Args:
        path: The file.
        wanted: Names of the arrays, each with its number of columns; 0 for an array (T,) instead of (T, C).
        optional: Those of them that may be missing.

    Raises:
        SourceError: zarr is not installed; the file is missing or no zip of zarr version 2; an array is
            missing, has another shape or kind of number, is too large, or is packed in another way.
    """
    zarr = zarr_module()
    with reading(KIND, path, "a zip of zarr version 2", SourceError):
        if path.exists() and not path.is_file():
            raise SourceError(f"{KIND} '{path}' is not a file, valid: a zip of zarr version 2")
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            names = [name for name in wanted if name not in optional or f"{name}/.zarray" in sizes]
            _check_present(path, names, sizes)
            chunks = {name: _chunks(name, sizes) for name in names}
            for name in names:
                _check_array(path, archive, name, wanted[name], chunks[name])
            attributes = {}
            if ".zattrs" in sizes:
                attributes = json.loads(_read(archive, ".zattrs", MAX_ENTRY))  # Python's, which knows NaN
            entries = [entry for name in names for entry in chunks[name]]
            unpacked = sum(sizes[entry] for entry in entries)
            if unpacked > MAX_UNPACKED:
                raise SourceError(
                    f"{KIND} '{path}' holds {unpacked} bytes to read, valid: at most {MAX_UNPACKED}"
                )
            for entry in entries:
                archive.read(entry)  # checks its sum: zarr takes a damaged chunk as it is
        store = zarr.storage.ZipStore(path, mode="r")
        try:
            found = {
                name: np.asarray(zarr.open_array(store, path=name, mode="r", zarr_format=2)[:])
                for name in names
            }
        finally:
            store.close()
    return Archive(found, attributes if isinstance(attributes, dict) else {}, digest)


def episode_slices(path: Path, ends: NDArray[np.int64]) -> list[slice]:
    """The rows of each episode of a file. Raises: SourceError, `ends` (E,) do not rise from above 0."""
    if not (len(ends) > 0 and ends[0] > 0 and bool((np.diff(ends) > 0).all())):
        raise SourceError(f"{KIND} '{path}': meta/episode_ends must rise from above 0")
    return [slice(int(start), int(end)) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def _check_present(path: Path, names: list[str], sizes: Mapping[str, int]) -> None:
    missing = [name for name in names if f"{name}/.zarray" not in sizes]
    if not missing:
        return
    if any(entry.rpartition("/")[2] == "zarr.json" for entry in sizes):
        raise SourceError(f"{KIND} '{path}' are of zarr version 3, valid: version 2, as UMI writes")
    arrays = sorted(entry.removesuffix("/.zarray") for entry in sizes if entry.endswith("/.zarray"))
    raise SourceError(
        f"{KIND} '{path}' have no array {', '.join(missing)}, valid: {', '.join(names)}; "
        f"found: {', '.join(arrays)[:500] or 'none'}"
    )


def _check_array(path: Path, archive: zipfile.ZipFile, name: str, columns: int, entries: list[str]) -> None:
    """Whether an array is what it should be, and its chunks are what it says. Raises: SourceError."""
    where, description = f"{KIND} '{path}': {name}", f"{name}/.zarray"
    with reading(f"{KIND} '{path}':", description, "one of plain numbers in zarr version 2", SourceError):
        array = msgspec.json.decode(_read(archive, description, MAX_ENTRY), type=_Description)
        kind = np.dtype(array.dtype)
    if kind.kind not in ("iuf" if columns else "iu") or kind.itemsize > 8:
        valid = "integers or floats" if columns else "integers"
        raise SourceError(f"{where} has numbers of type {array.dtype}, valid: {valid} of at most 8 bytes")
    tail = (columns,) if columns else ()
    if len(array.shape) != 1 + len(tail) or array.shape[1:] != tail or array.shape[0] > MAX_ROWS:
        valid = f"(T, {columns})" if columns else "(E,)"
        raise SourceError(f"{where} has shape {array.shape}, valid: {valid} of at most {MAX_ROWS} rows")
    if len(array.chunks) != len(array.shape) or array.chunks[1:] > tail or array.chunks[0] > MAX_ROWS:
        valid = f"no wider, and of at most {MAX_ROWS} rows"
        raise SourceError(f"{where} of shape {array.shape} has chunks {array.chunks}, valid: {valid}")
    count = math.prod(-(-size // chunk) for size, chunk in zip(array.shape, array.chunks, strict=True))
    if count > MAX_CHUNKS:
        raise SourceError(f"{where} has {count} chunks, valid: at most {MAX_CHUNKS}")
    for entry in entries:
        size = archive.getinfo(entry).file_size
        if array.compressor is not None:
            with archive.open(entry) as file:
                size = int.from_bytes(file.read(BLOSC_HEADER)[4:8], "little")
        if size != array.chunk_bytes:
            raise SourceError(f"{where}: {entry} unpacks to {size} bytes, valid: {array.chunk_bytes}")


def _chunks(name: str, entries: Iterable[str]) -> list[str]:
    """The entries of a zip that are chunks of an array."""
    own = (entry for entry in entries if entry.startswith(f"{name}/"))
    return [entry for entry in own if not entry.startswith(f"{name}/.z")]


def _read(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """An entry of a zip. Raises: ValueError, it is larger; zipfile's own errors, it is damaged."""
    size = archive.getinfo(name).file_size
    if size > most:
        raise ValueError(f"'{name}' has {size} bytes, valid: at most {most}")
    return archive.read(name)
