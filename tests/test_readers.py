"""Readers of files: one line for whatever is wrong; what a file merely claims is not allocated."""

import os
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wbc_bench.cli.main import main
from wbc_bench.errors import BenchError, StoreError
from wbc_bench.readers import (
    LARGEST_FILE,
    read_bytes,
    read_digest,
    read_json,
    read_parquet,
    read_text,
    read_toml,
    reading,
)


class Thing(msgspec.Struct, forbid_unknown_fields=True):
    number: int


def refused(call, *words: str) -> None:
    with pytest.raises(StoreError) as caught:
        call()
    line = str(caught.value)
    assert "\n" not in line and len(line) < 1500
    for word in words:
        assert word in line, line


@pytest.mark.parametrize("read", [read_bytes, read_text, read_digest, read_parquet])
def test_what_is_no_file(tmp_path: Path, read) -> None:
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    for name, word in (
        ("none", "does not exist"),
        (".", "is not a file"),
        ("loop", "cannot be read"),
        ("pipe", "is not a file"),
        ("n" * 300, "File name too long"),
    ):
        path = tmp_path / name
        refused(lambda path=path: read(path, "thing", StoreError), "thing", str(path), word)


def test_a_file_that_may_not_be_read(tmp_path: Path, monkeypatch) -> None:
    """By the system's answer: a privileged user is never refused."""
    path = tmp_path / "file"
    path.touch()

    def deny(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", deny)
    refused(lambda: read_bytes(path, "thing", StoreError), "Permission denied", str(path))


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    refused(lambda: read_bytes(path, "thing", StoreError), f"valid: at most {LARGEST_FILE}")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (b"", "truncated"),
        (b'{"number": "1"}', "Expected `int`, got `str` - at `$.number`"),
        (b'{"number": 1, "more": 2}', "unknown field `more`"),
        (b'{"number": \xff}', ""),
        (b"[" * 100_000, ""),
        (b'{"number": ' + b"[" * 100_000 + b"]" * 100_000, ""),
    ],
)
def test_json(tmp_path: Path, text: bytes, word: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(text)
    refused(lambda: read_json(path, Thing, "thing", StoreError), "thing", "x.json", word)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (b"number = [", ""),
        (b"number = 1.5", "Expected `int`"),
        (b"number = " + b"9" * 5000, ""),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"number = 1 # \xff", "utf-8"),
    ],
)
def test_toml(tmp_path: Path, text: bytes, word: str) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(text)
    refused(lambda: read_toml(path, Thing, "thing", StoreError), "thing", "x.toml", word)


@pytest.mark.parametrize("text", ["", "\n", "abc  x", "g" * 64, "A" * 64])
def test_a_hash_file_holds_a_hash(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.sha256"
    path.write_text(text)
    refused(lambda: read_digest(path, "hash", StoreError), "x.sha256", "valid: a SHA-256 of 64")
    path.write_text("a" * 64 + "  x.parquet\n")
    assert read_digest(path, "hash", StoreError) == "a" * 64


def test_columns_of_a_table(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"a": [1, 2], "b": ["x", None]}), path)
    wanted = {"a": "int64"}
    assert read_parquet(path, "thing", StoreError, wanted, rows=2).num_rows == 2
    refused(lambda: read_parquet(path, "thing", StoreError, wanted, rows=3), "2 rows, valid: 3")
    refused(lambda: read_parquet(path, "thing", StoreError, {"c": "int64"}), "has columns a, b, valid: c")
    refused(lambda: read_parquet(path, "thing", StoreError, {"a": "double"}), "a is of type int64")
    refused(lambda: read_parquet(path, "thing", StoreError, {"b": "string"}), "b has empty cells")
    path.write_bytes(path.read_bytes()[:-9])
    refused(lambda: read_parquet(path, "thing", StoreError), "not readable parquet")


def test_many_rows_in_few_bytes_are_not_allocated(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"a": pa.nulls(100_000_000, pa.int8())}), path)
    assert path.stat().st_size < 1 << 20
    before = pa.default_memory_pool().max_memory()
    refused(lambda: read_parquet(path, "thing", StoreError), "100000000 rows", "valid: at most")
    assert pa.default_memory_pool().max_memory() - before < 1 << 26


def test_what_is_not_the_files_fault_passes() -> None:
    with pytest.raises(BenchError, match="mine"), reading("thing", "x", "any", StoreError):
        raise BenchError("mine")
    with pytest.raises(KeyboardInterrupt), reading("thing", "x", "any", StoreError):
        raise KeyboardInterrupt


def test_control_characters_of_a_file_do_not_break_the_line() -> None:
    assert str(StoreError("a\nb\x1b[2Jc")) == "a b [2Jc"


@pytest.mark.parametrize("name", ["n" * 300, "n" * 300 + ".toml", "日" * 100])
def test_names_that_no_file_has(name: str, capsys, tmp_path: Path) -> None:
    for words in (
        ["eval", "--controller", "hold", "--protocol", name],
        ["eval", "--controller", f"learned:{name}.safetensors", "--protocol", "smoke_v1"],
        ["eval", "--controller", f"onnx:{name}.onnx", "--protocol", "smoke_v1"],
        ["track", "--controller", "hold", "--source", f"diffusion:{name}"],
        ["protocol", "verify", name],
    ):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        told = capsys.readouterr().err
        assert stopped.value.code == 2 and told.count("\n") == 1 and name in told, told
