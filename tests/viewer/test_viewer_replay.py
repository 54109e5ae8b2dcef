"""An episode of a stored run is seen again as it was, and the page that shows it needs nothing else."""

import dataclasses
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from runs import evaluated
from tiny_protocol import write_tiny
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.evaluation.evaluate import evaluate
from wbc_bench.results.gallery import replay_command
from wbc_bench.results.store import ResultStore, Run
from wbc_bench.viewer import rerun as rerun_module
from wbc_bench.viewer.moment import Moment, Skeleton
from wbc_bench.viewer.rerun import rerun

# The stance of an episode far from the others', and a rounding that depends on the number of episodes
BATCHED = """
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

class Mine:
    info = ControllerInfo("mine", frozenset({"proprioception"}), 0.02, "a test")

    def __init__(self, robot):
        self.default_q = robot.default_q

    def reset(self, episodes, obs, target):
        pass

    def act(self, obs, target):
        return JointCommand(np.tile(self.default_q * (1 + 1e-15 * len(obs.active)), (len(obs.active), 1)))
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return evaluated(tmp_path_factory.mktemp("store"), "ik")


def test_a_rerun_equals_the_record_and_itself_to_the_last_bit(run: Run) -> None:
    first, second = rerun(run, 0), rerun(run, 0)
    assert not first.differences and first.verdict.startswith("verified")
    assert len(first.moments) == first.stored["steps"] + 1
    for a, b in zip(first.moments, second.moments, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    # what is seen is what was measured: the mean error of the last half second
    errors = np.array([moment.position_error for moment in first.moments[1:]])
    assert errors[-25:].mean() == pytest.approx(first.stored["position_error"], rel=1e-12)


def test_pushes_are_seen_when_they_happen(run: Run) -> None:
    again = rerun(run, 0)
    protocol, path = find_protocol("smoke_v1")
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(1)
    planned = rows.push_time[0][np.isfinite(rows.push_time[0])]
    pushed = np.array([moment.push_w.any() for moment in again.moments])
    begins = np.flatnonzero(pushed[1:] & ~pushed[:-1]) + 1
    assert len(begins) == (planned < again.moments[-1].time).sum() > 0
    for k, begin in enumerate(begins):
        assert 0 < again.moments[begin].time - planned[k] <= 0.02
        assert np.array_equal(again.moments[begin].push_w, rows.push_vel[0, 2 * k : 2 * k + 2])


def test_a_changed_record_is_not_verified(run: Run) -> None:
    again = rerun(run, 1)
    shifted = again.stored | {"position_error": float(again.again["position_error"]) + 0.001}
    changed = dataclasses.replace(again, stored=shifted)
    assert list(changed.differences) == ["position_error"]
    assert "the same outcome, but 1 of 27" in changed.verdict and "position_error by" in changed.verdict
    newer = dataclasses.replace(again, stored=again.stored | {"jerk": 0.5})  # of a version that measures more
    assert newer.differences == {"jerk": (0.5, None)} and "jerk None (recorded 0.5)" in newer.verdict


def test_a_controller_that_rounds_with_its_company_is_run_in_its_shard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "batched_in_replay.py"
    file.write_text(BATCHED)
    run = evaluated(tmp_path / "store", f"{file}:Mine")
    sizes = []
    inner = rerun_module._watched
    monkeypatch.setattr(rerun_module, "_watched", lambda *args: sizes.append(len(args[3])) or inner(*args))
    again = rerun(run, 4, controller=f"{file}:Mine")
    assert sizes == [1, 6] and not again.differences
    # on another processor the shard would cost minutes and prove nothing
    elsewhere = dataclasses.replace(
        run, record=type(run.record)(**{**_fields(run.record), "machine": {"processor": "another"}})
    )
    sizes.clear()
    assert "another" in rerun(elsewhere, 4, controller=f"{file}:Mine").verdict and sizes == [1]


def test_a_record_alone_never_runs_a_file(tmp_path: Path) -> None:
    """Whoever sends a record would run code on this machine: its controller must be installed, or given."""
    file, mark = tmp_path / "sent_along.py", tmp_path / "ran"
    file.write_text(BATCHED)
    run = evaluated(tmp_path / "store", f"{file}:Mine")
    file.write_text(f"open({str(mark)!r}, 'w')\n{BATCHED}")
    with pytest.raises(StoreError, match=r"not an installed controller: give `--controller .*sent_along"):
        rerun(run, 0)
    assert not mark.exists()
    rerun(run, 0, controller=f"{file}:Mine")
    assert mark.exists()


def test_a_run_of_a_user_s_own_protocol_is_replayed_by_the_command_of_its_report(tmp_path: Path) -> None:
    """As it is printed, in the folder of the records, after the protocol's own files are gone."""
    pytest.importorskip("viser")
    own = write_tiny(tmp_path)
    root = tmp_path / "out"
    evaluate("hold", str(own), out=root)
    for left in tmp_path.glob("tiny.*"):
        left.unlink()
    words = [sys.executable, "-m", "wbc_bench", *shlex.split(replay_command("tiny", "hold", 0, 1))[1:]]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0 and "verified: all" in done.stdout, done.stderr


def _fields(record) -> dict:
    return {name: getattr(record, name) for name in record.__struct_fields__}


def test_what_cannot_be_replayed_is_said(run: Run) -> None:
    with pytest.raises(StoreError, match=r"episode 6 is not in .* valid: 0 to 5"):
        rerun(run, 6)
    other = type(run.record)(**{**_fields(run.record), "protocol_digest": "0" * 64})
    with pytest.raises(StoreError, match="protocol digest"):
        rerun(dataclasses.replace(run, record=other), 0)
    store = ResultStore(run.path.parents[3])
    assert store.find("smoke_v1/ik/replicate_1").path == run.path == store.find(str(run.path)).path
    with pytest.raises(UnknownNameError, match="did you mean smoke_v1/ik/replicate_1"):
        store.find("smoke_v1/ik/replicate_0")


def test_the_page_is_one_file_that_asks_for_nothing(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from wbc_bench.viewer.replay import write_html

    path = tmp_path / "episode.html"
    again = rerun(run, 0)
    write_html(again, path)
    text = path.read_text()
    assert again.title in text and "verified: all" in text and "<polyline" in text
    shell = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", shell)
    assert [p.name for p in tmp_path.iterdir()] == ["episode.html"]


def test_the_support_polygon_is_that_of_the_soles_that_stand(run: Run) -> None:
    again = rerun(run, 3)
    skeleton = Skeleton(again.robot.model())
    moment: Moment = again.moments[0]
    skeleton.place(moment)
    up = np.array([0.0, 0.0, 100.0])
    both = skeleton.support(np.stack([up, up]))
    left = skeleton.support(np.stack([up, np.zeros(3)]))
    assert len(skeleton.support(np.zeros((2, 3)))) == 0
    assert len(left) == 4 and 4 <= len(both) <= 8
    foot = again.robot.facts.foot
    area = (foot.x[1] - foot.x[0]) * (foot.y[1] - foot.y[0])  # [m^2] of a sole that is flat
    assert _area(left) == pytest.approx(area, rel=0.02)
    assert _area(both) > 2 * area


def _area(corners: np.ndarray) -> float:
    """Shoelace formula; positive for a counter-clockwise polygon."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
