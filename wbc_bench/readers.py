"""Readers of files, one per kind; every damage of a file is one line that names the file and what is valid.

A file is a claim of its writer: bits flip, disks fill up, names are mistyped. Whatever a decoder raises on it
passes through `reading`, so no reader has to know the exceptions of the libraries below it.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from wbc_bench.errors import BenchError

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T")

LARGEST_FILE = 256 << 20  # [B] of any file that is read whole; the largest of a release has 7 MiB
LARGEST_TABLE = 512 << 20  # [B] of a table in memory: 100,000 rows of a manifest take 80 MiB


@contextlib.contextmanager
def reading(kind: str, path: Path | str, valid: str, error: type[BenchError]) -> Iterator[None]:
    """Turn what a decoder of a file raises into one line.

    Args:
        kind: What the file is, e.g. "run record".
        path: The file.
        valid: What its content must be, e.g. "readable parquet"; "" where people write it and the decoder's
            own text says which field is wrong.
        error: The error to raise.

    Raises:
        BenchError: `error`; errors of this package pass unchanged.
    """
    try:
        yield
    except BenchError:
        raise
    except FileNotFoundError as cause:
        raise error(f"{kind} '{path}' does not exist") from cause
    except Exception as cause:  # decoders of other projects raise what they like
        if isinstance(cause, OSError) and cause.strerror:  # pyarrow's own have none
            raise error(f"{kind} '{path}' cannot be read: {cause.strerror}") from cause
        text = " ".join(str(cause).split())[:500] or type(cause).__name__
        if isinstance(cause, RecursionError):
            text = "it is nested too deeply"
        if not valid:
            raise error(f"{kind} {path}: {text}") from cause
        raise error(f"{kind} '{path}' is damaged or not {valid}, it cannot be read: {text}") from cause


def is_file(path: Path) -> bool:
    """Whether a file is there; False also for a name that no file can have, where `Path` raises."""
    return os.path.isfile(path)  # noqa: PTH113


def read_bytes(path: Path, kind: str, error: type[BenchError]) -> bytes:
    """The content of a file. Raises: `error`: missing, unreadable, no file, or too large."""
    with reading(kind, path, "a file", error):
        # neither a pipe, which would wait for its writer, nor a device, which may never end
        if path.exists() and not path.is_file():
            raise error(f"{kind} '{path}' is not a file")
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise error(f"{kind} '{path}' has {size} bytes, valid: at most {LARGEST_FILE}")
        return path.read_bytes()


def read_text(path: Path, kind: str, error: type[BenchError]) -> str:
    """The text of a file. Raises: `error`: see `read_bytes`, or it is not UTF-8."""
    data = read_bytes(path, kind, error)
    with reading(kind, path, "UTF-8 text", error):
        return data.decode("utf-8")


def read_toml(path: Path, schema: type[T], kind: str, error: type[BenchError]) -> T:
    """The struct of a TOML file that is a `kind` ("protocol", ...).

    Raises: `error`: see `read_bytes`; no TOML, an unknown key or a wrong type, with the path of the field.
    """
    data = read_bytes(path, f"{kind} file", error)
    with reading(kind, path, "", error):
        return msgspec.toml.decode(data, type=schema)


def read_json(path: Path, schema: type[T], kind: str, error: type[BenchError]) -> T:
    """The value of a JSON file. Raises: `error`: see `read_bytes` and `decode_json`."""
    return decode_json(read_bytes(path, kind, error), path, schema, kind, error)


def decode_json(
    data: bytes | str, path: Path | str, schema: type[T], kind: str, error: type[BenchError]
) -> T:
    """The value of JSON text that came from `path`. Raises: `error`: no JSON, or not of the schema."""
    with reading(kind, path, "JSON of this kind", error):
        return msgspec.json.decode(data, type=schema)


def read_digest(path: Path, kind: str, error: type[BenchError]) -> str:
    """The SHA-256 in a file as `sha256sum` writes it.

    Raises: `error`: see `read_text`, or it does not begin with 64 hexadecimal digits.
    """
    words = read_text(path, kind, error).split()
    if not words or not re.fullmatch("[0-9a-f]{64}", words[0]):
        found = f"'{words[0][:80]}'" if words else "nothing"
        raise error(f"{kind} '{path}' holds {found}, valid: a SHA-256 of 64 hexadecimal digits")
    return words[0]


def read_parquet(
    path: Path,
    kind: str,
    error: type[BenchError],
    columns: Mapping[str, str] | None = None,
    rows: int | None = None,
    only: list[str] | None = None,
    **options: Any,
) -> "pa.Table":
    """The table of a parquet file. Raises: `error`: see `read_bytes` and `decode_parquet`."""
    return decode_parquet(read_bytes(path, kind, error), path, kind, error, columns, rows, only, **options)


def decode_parquet(
    data: bytes,
    path: Path | str,
    kind: str,
    error: type[BenchError],
    columns: Mapping[str, str] | None = None,
    rows: int | None = None,
    only: list[str] | None = None,
    **options: Any,
) -> "pa.Table":
    """The table of the bytes of a parquet file.

    Args:
        data: Bytes of the file: pyarrow would take a path with a tilde or a colon for a home folder or a URI.
        path: Where they came from.
        kind: What the file is.
        error: The error to raise.
        columns: Columns that the table must have, with the names of their types in arrow.
        rows: Number of rows that it must have.
        only: Names of the columns to read, as far as they are there; all when None.
        options: Of `pyarrow.parquet.ParquetFile`.

    Raises:
        BenchError: `error`: no parquet, larger in memory than `LARGEST_TABLE`, or of other columns or rows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with (
        reading(kind, path, "readable parquet", error),
        # On this thread: one of arrow's pool that is still starting aborts a process that ends just then.
        pq.ParquetFile(pa.BufferReader(data), pre_buffer=False, **options) as file,
    ):
        parts = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
        found = file.metadata.num_rows
        size = max(sum(part.total_byte_size for part in parts), 8 * found * len(file.schema))
        if size > LARGEST_TABLE:
            raise error(
                f"{kind} '{path}' holds {found} rows of {size} bytes, valid: at most {LARGEST_TABLE} bytes"
            )
        if rows is not None and found != rows:
            raise error(f"{kind} '{path}' has {found} rows, valid: {rows}")
        table = file.read(columns=only, use_threads=False)
        table.validate(full=True)
    check_columns(table, path, kind, error, columns or {})
    return table


def check_columns(
    table: "pa.Table", path: Path | str, kind: str, error: type[BenchError], columns: Mapping[str, str]
) -> None:
    """Check a table as `decode_parquet` does. Raises: `error`: a column is missing or of another type."""
    names = table.column_names
    if len(set(names)) < len(names):
        raise error(f"{kind} '{path}' has two columns of one name, valid: each once")
    for name, wanted in columns.items():
        if name not in names:
            raise error(f"{kind} '{path}' has columns {', '.join(names)[:500]}, valid: {', '.join(columns)}")
        found = str(table.schema.field(name).type).removeprefix("large_")
        if found != wanted:
            raise error(f"{kind} '{path}': column {name} is of type {found}, valid: {wanted}")
        if wanted != "double" and table[name].null_count:  # there it is NaN, as pandas writes it
            raise error(f"{kind} '{path}': column {name} has empty cells, valid: a value in every row")
