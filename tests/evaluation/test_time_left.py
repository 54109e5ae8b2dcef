"""The time left of an evaluation: measured per controller, and unknown where nothing was measured."""

import pytest

from wbc_bench.evaluation.time_left import TimeLeft


def test_a_fast_controller_says_nothing_of_a_slow_one():
    """Two workers, 200 episodes each; `fast` takes 0.1 s per episode and `slow` 1 s."""
    left = TimeLeft({"fast": 200, "slow": 200}, workers=2)
    assert left.text() == "time left unknown"
    said = []
    for _ in range(4):
        left.add("fast", 50, 0.0, 5.0)
        said.append(left.text())
    assert said == [
        "time left unknown",  # of one shard
        "at least 5 s left, 1 controller not measured yet",
        "at least 2 s left, 1 controller not measured yet",
        "time left unknown",
    ]
    left.add("slow", 50, 0.0, 40.0)
    assert left.text() == "time left unknown"
    left.add("slow", 50, 0.0, 60.0)
    assert left.text() == "50 s left"  # 100 episodes at 1 s by two workers
    for _ in range(2):
        left.add("slow", 50, 0.0, 50.0)
    assert left.text() == "0 s left"


@pytest.mark.parametrize(("starts", "seconds"), [((0.0, 0.0, 0.0, 0.0), 10), ((0.0, 10.0, 20.0, 30.0), 40)])
def test_workers_of_a_cluster_are_counted_by_what_they_did(starts, seconds):
    """Four shards of 10 s at a time or one after the other, and as many again."""
    left = TimeLeft({"a": 400}, workers=None)
    for start in starts:
        left.add("a", 50, start, 10.0)
    assert left.text() == f"{seconds} s left"
