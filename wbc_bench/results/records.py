"""A run as two files: its data as parquet, and a JSON record of what was run."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wbc_bench.errors import StoreError
from wbc_bench.files import folder_name, write_atomic
from wbc_bench.readers import decode_parquet, read_bytes, read_json


class Driven(Protocol):
    """What a record says of a controller that a source of targets drove."""

    @property
    def source(self) -> str: ...
    @property
    def controller(self) -> str: ...
    @property
    def condition(self) -> str: ...
    @property
    def seed(self) -> int: ...


LARGEST = 1e6  # [m, rad, s] of what is measured in an episode
Record = TypeVar("Record", bound=msgspec.Struct)


def parquet_of(table: pa.Table) -> tuple[bytes, str]:
    """A table as the bytes of a parquet file, and their SHA-256."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", use_dictionary=False)
    data = sink.getvalue().to_pybytes()
    return data, hashlib.sha256(data).hexdigest()


def driven_folder(root: Path, kind: str, record: Driven) -> Path:
    """`<root>/<kind>/<source>/<controller>/<condition>_<seed>`"""
    name = f"{record.condition}_{record.seed}"
    return root / kind / folder_name(record.source) / folder_name(record.controller) / name


def write_record(path: Path, record: msgspec.Struct, beside: Path, data: bytes) -> None:
    """Write the data, and after it the record that says whose they are.

    Raises: StoreError when the folder cannot be written.
    """
    folder = path.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot create '{folder}': {error.strerror}") from error
    write_atomic(beside, data)
    write_atomic(path, msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n")


def read_record(
    path: Path, kind: type[Record], beside: Path, digest: str, columns: Mapping[str, str]
) -> tuple[Record, pa.Table]:
    """A record, and the data beside it, whose SHA-256 stands in its field `digest`.

    Args:
        path: The record.
        kind: Its type.
        beside: The data.
        digest: Field of the record with their SHA-256.
        columns: Columns that the data must have, with their types.

    Raises: StoreError when one cannot be read, or the data are not those it was written with.
    """
    record = read_json(path, kind, "record", StoreError)
    data = read_bytes(beside, "data of a record", StoreError)
    if hashlib.sha256(data).hexdigest() != getattr(record, digest):
        raise StoreError(f"'{beside}' is not what its {path.name} was written for: another sha256")
    return record, decode_parquet(data, beside, "data of a record", StoreError, columns)


def refuse_values(path: Path, mistakes: Iterable[tuple[str, object, str]]) -> None:
    """Refuse the first of (name, value, what is valid). Raises: StoreError, there is one."""
    for name, value, valid in mistakes:
        raise StoreError(f"record '{path}': {name} is {value}, valid: {valid}")


def not_finite(frame: pd.DataFrame, columns: Iterable[str]) -> Iterator[tuple[str, object, str]]:
    """Columns with a number that no meter, radian or second of an episode is, for `refuse_values`."""
    for name in columns:
        values = np.asarray(frame[name], dtype=np.float64)
        if not (np.abs(values) <= LARGEST).all():
            yield f"column {name}", f"{values.min():g} to {values.max():g}", f"numbers up to {LARGEST:g}"
