"""Records of benchmarks: what is written, and one build beside another."""

import importlib.metadata as metadata
import json

import msgspec
import pandas as pd
import pytest

from commands import fails
from wbc_bench.cli.main import main
from wbc_bench.errors import StoreError
from wbc_bench.results.benchmark import BenchmarkRecord, against_table, benchmark_table, read_benchmark


def frame(first: float = 2.0) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "package": ["fast 1.2", "slow 3.0", "missing"],
            "median [ms]": [first, 8.0, float("nan")],
            "steps": [10, 20, 30],
            "note": ["", "", "not installed"],
        }
    )


def test_a_record_comes_back_as_it_was(tmp_path) -> None:
    record = BenchmarkRecord.of("mine", frame())
    path = tmp_path / "mine.json"
    path.write_bytes(record.json())
    assert read_benchmark(path) == record
    assert record.rows[2] == ["missing", None, 30, "not installed"]
    assert record.machine["cores"] and record.versions["wbc-bench"]
    assert benchmark_table(record).rows[0] == ("fast 1.2", "2", "10", "")
    assert benchmark_table(record).rows[2][1] == "–"


def test_numbers_are_divided_row_by_row() -> None:
    before = BenchmarkRecord.of("mine", frame())
    later = frame(first=1.0).assign(package=["fast 2.0", "new 1.0", "missing"])
    now = msgspec.structs.replace(BenchmarkRecord.of("mine", later), versions={"wbc-bench": "9"})
    table = against_table(now, before)
    assert table.header == ("package", "median [ms]", "steps")
    assert table.rows == (
        ("fast 2.0", "0.500", "1.000"),  # another version of the same package
        ("new 1.0", "–", "–"),
        ("missing", "–", "1.000"),
    )
    assert len(table.notes) == 1 and "Other packages" in table.notes[0]
    moved = msgspec.structs.replace(before, machine=before.machine | {"processor": "another"})
    assert "Another machine: processor another → " in against_table(before, moved).notes[0]
    with pytest.raises(StoreError, match=r"of benchmark 'mine', valid: one of 'other'"):
        against_table(BenchmarkRecord.of("other", frame()), before)


@pytest.fixture
def one_benchmark(monkeypatch) -> None:
    point = metadata.EntryPoint("mine", "test_benchmark_record:frame", "wbc_bench.benchmarks")
    other = metadata.EntryPoint("other", "test_benchmark_record:frame", "wbc_bench.benchmarks")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point, other])


def test_the_command_writes_a_record_and_compares_with_it(one_benchmark, tmp_path, capsys) -> None:
    main(["bench", "mine", "--out", str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "mine.csv",
        "mine.json",
        "mine.md",
        "mine.tex",
    ]
    capsys.readouterr()
    main(["bench", "--against", str(tmp_path / "mine.json")])
    said = capsys.readouterr().out
    assert "Benchmark mine" in said and "this build over commit" in said and "1.000" in said
    assert "other" not in said  # the record says which


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        (None, (), "record of a benchmark"),
        ("{", (), "record of a benchmark"),
        ({"rows": [["a", 1]]}, (), "a row of 2 cells, valid: 4"),
        ({"rows": [["a", [], 1, ""]]}, (), "JSON of this kind"),
        ({"benchmark": "unheard"}, (), "unknown benchmark 'unheard'"),
        ({}, ("other",), "a record of 'mine', valid: with that one alone"),
    ],
)
def test_a_bad_record_is_one_line(one_benchmark, tmp_path, capsys, text, words, message) -> None:
    path = tmp_path / "old.json"
    if isinstance(text, dict):
        text = json.dumps(json.loads(BenchmarkRecord.of("mine", frame()).json()) | text)
    if text is not None:
        path.write_text(text)
    out = tmp_path / "out"
    line = fails(capsys, "bench", *words, "--against", str(path), "--out", str(out))
    assert message in line
    assert not out.exists()
