"""An evaluation on a severity ladder: resumed, grown and reused like any other, and seen again."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tiny_ladder import write_ladder
from user_controllers import write_controller
from wbc_bench.episodes.ladder import find_ladder
from wbc_bench.errors import BenchError, StoreError, UnknownNameError
from wbc_bench.evaluation import workers as workers_module
from wbc_bench.evaluation.evaluate import EvaluationError
from wbc_bench.evaluation.stress import allow_open_files, evaluate_stress
from wbc_bench.evaluation.workers import Engine
from wbc_bench.publish import publish
from wbc_bench.results.store import ResultStore
from wbc_bench.results.stress import RECORD, read_stress
from wbc_bench.viewer.rerun import rerun

LEVELS = 6  # of the tiny ladder, the base among them


@pytest.fixture
def tiny(tmp_path) -> Path:
    return write_ladder(tmp_path)


def climbed(path: Path, out: Path, *specs: str, engine: Engine | None = None, **options) -> ResultStore:
    ladder = find_ladder(str(path))
    return evaluate_stress(specs or ("hold",), ladder, out, engine or Engine(), **options)


def record_bytes(root: Path) -> dict[str, bytes]:
    paths = sorted(root.glob("stress/*/runs/*/*/*/episodes.parquet"))
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}


def test_every_level_is_evaluated_once_for_every_controller(tiny, tmp_path, capsys):
    climbed(tiny, tmp_path / "out", "hold", "ik:kinematic", "hold")
    found = record_bytes(tmp_path / "out")
    assert len(found) == 2 * LEVELS
    assert sum("climb@base/hold" in name for name in found) == 1
    (stress,) = read_stress(tmp_path / "out")
    assert [climb.spec for climb in stress.climbs] == ["hold", "ik:kinematic"]
    assert {name: solved.shape for name, solved in stress.climbs[0].levels.items()} == {
        **{"friction": (4, 2), "noise": (4, 3), "delay": (4, 2)}
    }


def test_two_workers_and_some_factors_at_a_time_give_the_same_bytes(tiny, tmp_path, capsys):
    climbed(tiny, tmp_path / "one")
    climbed(tiny, tmp_path / "two", factors=["noise"], engine=Engine(workers=2))
    (part,) = read_stress(tmp_path / "two")
    assert list(part.climbs[0].levels) == ["noise"]
    climbed(tiny, tmp_path / "two", factors=["delay", "friction"])
    assert record_bytes(tmp_path / "one") == record_bytes(tmp_path / "two")
    assert "hold: 1 of 4 runs reused" in capsys.readouterr().err  # the base
    records = [(tmp_path / name / "stress" / "climb" / RECORD).read_bytes() for name in ("one", "two")]
    assert records[0] == records[1]


def test_nothing_is_computed_twice_and_fewer_episodes_grow(tiny, tmp_path, capsys, monkeypatch):
    climbed(tiny, tmp_path / "whole")
    climbed(tiny, tmp_path / "out", episodes=2)
    assert read_stress(tmp_path / "out")[0].climbs[0].episodes == 2
    climbed(tiny, tmp_path / "out")
    assert record_bytes(tmp_path / "out") == record_bytes(tmp_path / "whole")
    monkeypatch.setattr(workers_module, "evaluate_shard", None)
    capsys.readouterr()
    climbed(tiny, tmp_path / "out")
    assert capsys.readouterr().err.splitlines() == [f"hold: {LEVELS} of {LEVELS} runs reused, 0 resumed"]
    with pytest.raises(RuntimeError, match="NoneType"):  # now it is computed
        climbed(tiny, tmp_path / "out", overwrite=True)


def test_an_episode_of_a_level_is_seen_again(tiny, tmp_path):
    store = climbed(tiny, tmp_path / "out", factors=["delay"])
    run = store.find("climb@delay@0.02/hold/replicate_0")
    again = rerun(run, 2)
    assert again.verdict.startswith("verified") and again.protocol.name == "climb@delay@0.02"
    assert again.protocol.randomization.command_delay == (0.02, 0.02)


def test_killed_then_resumed(tiny, tmp_path):
    """While the third level is computed, and the controller waits for as long as a file is there."""
    stop, runs = tmp_path / "stop", "stress/*/runs/*/*/*/run.json"
    stop.touch()
    third = f"len(list(Path({str(tmp_path / 'out')!r}).glob({runs!r}))) == 2"
    waits = f"while Path({str(stop)!r}).exists() and {third}: time.sleep(0.05)"
    spec = write_controller(tmp_path, "waiting_controller", waits)
    command = [sys.executable, "-m", "wbc_bench", "stress", "--ladder", str(tiny), "--controller", spec]
    command += ["--workers", "1", "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while len(list((tmp_path / "out").glob(runs))) < 2:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    stop.unlink()
    kept = record_bytes(tmp_path / "out")
    assert len(kept) == 2
    publish(ResultStore(tmp_path / "out"), tmp_path / "out")  # what is whole has a report already
    climbed(tiny, tmp_path / "out", spec)
    climbed(tiny, tmp_path / "whole", spec)
    found = record_bytes(tmp_path / "out")
    assert found == record_bytes(tmp_path / "whole") and kept.items() <= found.items()


def test_as_many_runs_may_be_open_as_there_are_levels():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft - 10, hard))
        allow_open_files(soft - 20)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (soft - 10, hard)  # it is never lowered
        allow_open_files(soft)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (soft, hard)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_another_ladder_of_that_name_is_refused(tiny, tmp_path):
    climbed(tiny, tmp_path / "out", factors=["noise"])
    before = record_bytes(tmp_path / "out")
    write_ladder(tmp_path, "[0.8, 0.4]", "[0.8, 0.3]")
    for overwrite in (False, True):
        with pytest.raises(StoreError, match="another ladder 'climb'"):
            climbed(tiny, tmp_path / "out", factors=["noise"], overwrite=overwrite)
    assert record_bytes(tmp_path / "out") == before


def test_a_run_of_another_version_of_a_level_is_refused(tiny, tmp_path):
    climbed(tiny, tmp_path / "out", factors=["noise"])
    path = tmp_path / "out" / "stress" / "climb" / RECORD
    (stress,) = read_stress(tmp_path / "out")
    digest = stress.ladder.factors[1].levels[1].digest
    path.write_text(path.read_text().replace(digest, "0" * 64))
    with pytest.raises(StoreError, match="climb@noise@2/hold/replicate_0' is not of a level of"):
        read_stress(tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": 5}, EvaluationError, r"--episodes 5: valid: 1 to 4 \(episodes per level"),
        ({"episodes": 0}, EvaluationError, "--episodes 0: valid: 1 to 4"),
        ({"factors": ["nois"]}, UnknownNameError, "did you mean noise"),
    ],
)
def test_mistakes_leave_nothing_behind(tiny, tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        climbed(tiny, tmp_path / "out", **options)
    with pytest.raises(BenchError, match="did you mean hold"):
        climbed(tiny, tmp_path / "out", "hodl")
    tiny.with_name("tiny.parquet").unlink()
    with pytest.raises(BenchError, match="does not exist"):
        climbed(tiny, tmp_path / "out")
    assert not (tmp_path / "out").exists()
