"""Damage to files, drawn from a random generator: bits, lengths, values, columns, and no file at all."""

import hashlib
import io
import json
import os
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Rng = np.random.Generator
Mutation = Callable[[Rng, bytes], bytes]

MANY = 100_000  # rows of a table that is not damaged further
EXTREMES: list[Any] = [
    *(-1, 0, 1, 2**31, 2**63, -(2**63), 10**30, 0.5, -0.5, 1e308, -1e308, 1e-308, True, None),
    *("", "x", "日本", "a/../../b", "n" * 300, "\x00", "nan", [], {}, [[]], {"a": 1}, [1, 2, 3]),
]
LITERALS = [  # of numbers in text
    *(b"0", b"-1", b"1e308", b"-1e-308", b"1e400", b"nan", b"inf", b"-inf", b"true", b'""', b"[]", b"{}"),
    *(b"9223372036854775808", b"1" + b"0" * 30, b"9" * 5000, b"0.0", b"1.5", b"null", b"1_000_000_000"),
]


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def reseal(record: Path, field: str, data: Path) -> None:
    """Put the SHA-256 of a file into the JSON beside it, damaged or not."""
    text = re.sub(
        rf'("{field}":\s*")[0-9a-f]*"', rf'\g<1>{sha256(data)}"', record.read_text(errors="replace")
    )
    record.write_text(text)


def damage(rng: Rng, path: Path) -> str:
    """Damage one file in place; what was done, for the report of a failure."""
    choices: list[tuple[str, Callable[[Rng, Path], None]]] = [
        (name, lambda rng, path, change=change: _rewrite(rng, path, change))
        for name, change in (*_BYTES, *_OF_SUFFIX.get(path.suffix, ()), *_OF_SUFFIX.get(path.suffix, ()))
    ]
    choices += _NAMES if rng.random() < 0.1 else []
    name, change = choices[rng.integers(len(choices))]
    change(rng, path)
    return name


def _rewrite(rng: Rng, path: Path, change: Mutation) -> None:
    path.write_bytes(change(rng, path.read_bytes()))


# --- bytes ----------------------------------------------------------------------------------------------


def flip(rng: Rng, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4)) if changed else 0):
        changed[rng.integers(len(changed))] ^= 1 << rng.integers(8)
    return bytes(changed)


def _span(rng: Rng, data: bytes) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(len(data), start + int(rng.integers(1, 65)))


def truncate(rng: Rng, data: bytes) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def cut_out(rng: Rng, data: bytes) -> bytes:
    start, stop = _span(rng, data)
    return data[:start] + data[stop:]


def repeat(rng: Rng, data: bytes) -> bytes:
    start, stop = _span(rng, data)
    return data[:stop] + data[start:stop] * int(rng.integers(1, 4)) + data[stop:]


def overwrite(rng: Rng, data: bytes) -> bytes:
    start, stop = _span(rng, data)
    fill = [b"\0", b"\xff", b"9", rng.bytes(1)][rng.integers(4)]
    return data[:start] + fill * (stop - start) + data[stop:]


def insert(rng: Rng, data: bytes) -> bytes:
    start, _ = _span(rng, data)
    return data[:start] + rng.bytes(int(rng.integers(1, 17))) + data[start:]


def replace_all(rng: Rng, data: bytes) -> bytes:
    return [b"", b"\n", rng.bytes(100), b"{}", b"PK\x03\x04", b"PAR1" * 3, b"[" * 100_000][rng.integers(7)]


_BYTES: list[tuple[str, Mutation]] = [
    *(("flip", flip), ("flip", flip), ("truncate", truncate), ("cut out", cut_out), ("repeat", repeat)),
    *(("overwrite", overwrite), ("insert", insert), ("replace all", replace_all)),
]

# --- text and JSON --------------------------------------------------------------------------------------


def number(rng: Rng, data: bytes) -> bytes:
    """Another number in the place of one."""
    found = list(re.finditer(rb"(?<![\w.])-?\d[\d.e+-]*", data))
    if not found:
        return data
    chosen = found[rng.integers(len(found))]
    return data[: chosen.start()] + LITERALS[rng.integers(len(LITERALS))] + data[chosen.end() :]


def string(rng: Rng, data: bytes) -> bytes:
    """Another text between quotes."""
    found = list(re.finditer(rb'"[^"\n]*"', data))
    if not found:
        return data
    chosen = found[rng.integers(len(found))]
    text = [b'""', b'"x"', '"ü/日"'.encode(), b'"' + b"n" * 300 + b'"', b'"../../x"', b"1", b'"\\u0000"']
    return data[: chosen.start()] + text[rng.integers(len(text))] + data[chosen.end() :]


def lines(rng: Rng, data: bytes) -> bytes:
    """A line less, twice, or in another place."""
    rows = data.splitlines(keepends=True)
    if not rows:
        return data
    line = rows.pop(rng.integers(len(rows)))
    for _ in range(rng.integers(3)):
        rows.insert(int(rng.integers(len(rows) + 1)), line)
    return b"".join(rows)


def nest(rng: Rng, data: bytes) -> bytes:
    """Brackets without an end in the place of a value."""
    value = [b"[" * 50_000, b"[" * 50_000 + b"]" * 50_000, b'{"a":' * 50_000, b"{a=" * 50_000][
        rng.integers(4)
    ]
    found = list(re.finditer(rb'(?<![\w.])-?\d[\d.e+-]*|"[^"\n]*"', data))
    if not found:
        return value
    chosen = found[rng.integers(len(found))]
    return data[: chosen.start()] + value + data[chosen.end() :]


def json_value(rng: Rng, data: bytes) -> bytes:
    """A value somewhere in the tree replaced, removed, or joined by another."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return data
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            places.append((node, key))
            walk(value)

    walk(tree)
    if not places:
        return data
    node, key = places[rng.integers(len(places))]
    how = rng.integers(4)
    if how == 0:
        del node[key]
    elif how == 1 and isinstance(node, dict):
        node[f"{key}x"] = EXTREMES[rng.integers(len(EXTREMES))]
    elif how == 2 and isinstance(node[key], int | float):
        node[key] = node[key] * [-1, 10, 1000, 0][rng.integers(4)] + rng.integers(-1, 2).item()
    else:
        node[key] = EXTREMES[rng.integers(len(EXTREMES))]
    return json.dumps(tree).encode()


# --- tables ---------------------------------------------------------------------------------------------


def _table(change: Callable[[Rng, pa.Table], pa.Table]) -> Mutation:
    def mutate(rng: Rng, data: bytes) -> bytes:
        try:
            sound = pq.read_table(pa.BufferReader(data))
            if len(sound) > MANY:  # inflated already
                return data
            table = change(rng, sound)
        except (pa.ArrowException, OSError, ValueError, TypeError, IndexError):
            # damaged already, or a change that cannot be made
            return data
        sink = io.BytesIO()
        pq.write_table(table, sink, compression="zstd")
        return sink.getvalue()

    return mutate


def _set(table: pa.Table, place: int, values: Any) -> pa.Table:
    return table.set_column(place, table.column_names[place], values)


def drop_column(rng: Rng, table: pa.Table) -> pa.Table:
    return table.remove_column(int(rng.integers(table.num_columns)))


def rename_column(rng: Rng, table: pa.Table) -> pa.Table:
    names = list(table.column_names)
    names[rng.integers(len(names))] = ["", "x", names[0], "日本"][rng.integers(4)]
    return table.rename_columns(names)


def add_column(rng: Rng, table: pa.Table) -> pa.Table:
    return table.append_column("more", pa.array([0.0] * len(table)))


def change_type(rng: Rng, table: pa.Table) -> pa.Table:
    place = int(rng.integers(table.num_columns))
    column = table.column(place)
    kinds = [pa.string(), pa.int32(), pa.float32(), pa.bool_(), pa.large_string(), pa.int64(), pa.float64()]
    if pa.types.is_fixed_size_list(column.type):
        kinds = [pa.list_(pa.float64()), pa.list_(pa.float32(), column.type.list_size)]
    return _set(table, place, column.cast(kinds[rng.integers(len(kinds))], safe=False))


def change_values(rng: Rng, table: pa.Table) -> pa.Table:
    """One cell, or all of a column, become another value of the type."""
    place = int(rng.integers(table.num_columns))
    kind = table.schema.field(place).type
    values = table.column(place).to_pylist()
    texts = ["", "x", "arm", "step", "beyond", "nominal", "success", None]
    numbers = [-1, 0, 1, 2**62, None]
    reals = [np.nan, np.inf, -np.inf, -1.0, 0.0, 1.0, 57.3, 1e308, None]
    for k in range(len(values)) if rng.random() < 0.5 else [int(rng.integers(max(1, len(values))))]:
        if k >= len(values):
            break
        if isinstance(values[k], list):
            values[k] = list(values[k])
            values[k][rng.integers(len(values[k]))] = reals[rng.integers(len(reals))]
        else:
            of_kind = texts if isinstance(values[k], str) else numbers if pa.types.is_integer(kind) else reals
            values[k] = of_kind[rng.integers(len(of_kind))]
    return _set(table, place, pa.array(values, kind))


def scale_values(rng: Rng, table: pa.Table) -> pa.Table:
    """Another unit: a column times a factor."""
    place = int(rng.integers(table.num_columns))
    kind = table.schema.field(place).type
    factor = [-1.0, 1e3, 1e-3, 57.29577951308232][rng.integers(4)]
    values: list[Any] = table.column(place).to_pylist() or [None]
    if isinstance(values[0], list):
        return _set(table, place, pa.array([[v * factor for v in row] for row in values], kind))
    if isinstance(values[0], float):
        return _set(table, place, pa.array([None if v is None else v * factor for v in values], kind))
    return table


def change_rows(rng: Rng, table: pa.Table) -> pa.Table:
    how = rng.integers(4)
    if how == 0:
        return table.slice(0, int(rng.integers(len(table) + 1)))
    if how == 1:
        return pa.concat_tables([table, table])
    if how == 2:
        return table.take(pa.array(rng.permutation(len(table))))
    return pa.concat_tables([table] * 2000)


def change_metadata(rng: Rng, table: pa.Table) -> pa.Table:
    return table.replace_schema_metadata([None, {}, {b"protocol": b"\xff"}, {b"x": b"y"}][rng.integers(4)])


def inflate(rng: Rng, table: pa.Table) -> pa.Table:
    """Many rows in few bytes."""
    count = 20_000_000
    return pa.table({name: pa.nulls(count, pa.int64()) for name in table.column_names[:2]})


_COLUMNS = [
    *(drop_column, rename_column, add_column, change_type, change_values, change_values, change_values),
    *(scale_values, change_rows, change_metadata),
]

# --- weights --------------------------------------------------------------------------------------------


def tensors(rng: Rng, data: bytes) -> bytes:
    """A tensor less or more, of another shape or type, or with another value."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load, save

    try:
        found, size = load(data), int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + size]).get("__metadata__")
    except (SafetensorError, ValueError, RecursionError):
        return data
    name = sorted(found)[rng.integers(len(found))]
    how, value = rng.integers(6), found[name]
    if how == 0:
        del found[name]
    elif how == 1:
        found["extra"] = torch.zeros(3)
    elif how == 2:
        found[name] = value.reshape(-1)[: max(1, value.numel() - 1)].clone()
    elif how == 3:
        found[name] = value.to([torch.float64, torch.int32, torch.bool, torch.bfloat16][rng.integers(4)])
    else:
        found[name] = torch.full_like(value, [torch.nan, torch.inf, 1e38, 0.0][rng.integers(4)])
    return save(found, metadata=metadata)


# --- zips -----------------------------------------------------------------------------------------------


def entry(rng: Rng, data: bytes) -> bytes:
    """An entry damaged, gone, twice, of another name, or huge; the sums of the zip fit what it holds."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [(info, archive.read(info)) for info in archive.infolist()]
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, RuntimeError, EOFError):
        return data  # damaged already
    if not entries:
        return data
    place, how = int(rng.integers(len(entries))), rng.integers(12)
    info, content = entries[place]
    changes = [flip, truncate, number, json_value, json_value, cut_out, insert, nest]
    if how < len(changes):
        entries[place] = (info, changes[how](rng, content))
    elif how == 8:
        del entries[place]
    elif how == 9:
        entries.insert(int(rng.integers(len(entries) + 1)), entries[place])
    elif how == 10:
        name = info.filename
        others = ["../x", "/x", f"{name}/0", name[:-1] + "1.0", "日本", "zarr.json", entries[0][0].filename]
        entries[place] = (zipfile.ZipInfo(others[rng.integers(len(others))]), content)
    else:
        entries[place] = (info, b"\0" * (16 << 20))
    sink, packing = io.BytesIO(), int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    with warnings.catch_warnings(), zipfile.ZipFile(sink, "w") as archive:
        warnings.simplefilter("ignore")  # two entries of one name
        for info, content in entries:
            archive.writestr(info.filename, content, packing)
    return sink.getvalue()


_TEXT: list[tuple[str, Mutation]] = [("number", number), ("string", string), ("lines", lines), ("nest", nest)]
_TABLES = [(change.__name__, _table(change)) for change in _COLUMNS]
_OF_SUFFIX: dict[str, list[tuple[str, Mutation]]] = {
    **dict.fromkeys((".toml", ".md", ".txt", ".sha256", ".jsonl", ".tex", ".csv"), _TEXT),
    ".json": [*_TEXT, ("value", json_value), ("value", json_value), ("value", json_value)],
    ".parquet": [*_TABLES, *_TABLES, ("inflate", _table(inflate))],
    ".safetensors": [("tensors", tensors)] * 4,
    ".zip": [("entry", entry)] * 6,
    ".py": _TEXT,
}

# --- the file itself ------------------------------------------------------------------------------------


def missing(rng: Rng, path: Path) -> None:
    path.unlink()


def a_folder(rng: Rng, path: Path) -> None:
    path.unlink()
    path.mkdir()


def a_loop(rng: Rng, path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def a_pipe(rng: Rng, path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def not_readable(rng: Rng, path: Path) -> None:
    path.chmod(0)  # root reads it all the same


_NAMES = [(change.__name__, change) for change in (missing, a_folder, a_loop, a_pipe, not_readable)] * 5
