"""What a long computation says on stderr where there is no terminal."""

import pytest

from wbc_bench import progress
from wbc_bench.progress import LINE_PERIOD, Progress


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the tests set, [s]."""
    seconds = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: seconds[0])
    return seconds


def test_the_first_result_is_shown_at_once_without_an_estimate(capsys, clock):
    with Progress("episodes") as bar:
        clock[0] = 2.0
        bar.update(4, 40, "ik")
        first = capsys.readouterr().err
        bar.update(8, 40, "ik")
        assert capsys.readouterr().err == ""
        clock[0] += LINE_PERIOD
        bar.update(12, 40, "ik")
        assert capsys.readouterr().err == "12/40 episodes, 1.0/s, 28 s left, ik\n"
    assert first == "4/40 episodes, 2.0/s, time left unknown, ik\n"


def test_all_at_once_is_one_line(capsys, clock):
    with Progress("episodes") as bar:
        clock[0] = 2.0
        bar.update(4, 4)
    assert capsys.readouterr().err == "4/4 episodes, 2.0/s, 2.0 s\n"


def test_who_knows_better_says_what_is_left(capsys, clock):
    with Progress("episodes") as bar:
        clock[0] = 2.0
        bar.update(4, 40, "ik", "at least 90 s left")
    assert capsys.readouterr().err.splitlines()[0] == "4/40 episodes, 2.0/s, at least 90 s left, ik"
