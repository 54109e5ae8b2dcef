"""The share of the physics in an evaluation is a part of it."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import pytest

from tiny_protocol import write_tiny
from wbc_bench.evaluation import benchmark, simulation
from wbc_bench.evaluation.benchmark import harness_share

SHARES = ["lowest shard", "physics / evaluation", "highest shard"]


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(benchmark, "SHARDS", 2)
    monkeypatch.setattr(benchmark, "SHARD_EPISODES", 3)
    return str(write_tiny(tmp_path, episodes=6))


def clocks(monkeypatch: pytest.MonkeyPatch, ticks: Iterator[float]) -> None:
    """Both modules read processor time from one clock, and wall time from none."""
    for module in (benchmark, simulation):
        monkeypatch.setattr(module, "time", SimpleNamespace(process_time=lambda: next(ticks)))


def test_the_physics_is_timed_inside_the_evaluation(small: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clocks(monkeypatch, (float(reading) for reading in count()))
    row = harness_share(["hold"], small).iloc[0]
    # a second between two readings: one in each call of the engine, one before it, and one at the end
    assert row["physics (s)"] > 0 and row["evaluation (s)"] == 2 * row["physics (s)"] + 2


def test_no_share_is_above_one(small: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clocks(monkeypatch, iter(process_time, None))
    row = harness_share(["hold"], small).iloc[0]
    lowest, whole, highest = row[SHARES]
    assert 0 < lowest <= whole <= highest <= 1 and row["control steps"] > 0


def test_a_controller_that_cannot_be_made_has_no_row(small: str) -> None:
    frame = harness_share(["hold", "learned:no_such_file.safetensors"], small)
    assert list(frame["controller"]) == ["hold"] and len(frame.columns) == 7
