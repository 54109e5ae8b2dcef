"""The Python interface: the rows of the command line, for a spec, an object and a class."""

import shutil
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest

import wbc_bench
from tiny_protocol import write_tiny
from user_controllers import write_controller
from wbc_bench.controller import ControllerInfo, JointCommand
from wbc_bench.errors import BenchError, ControllerError, StoreError, UnknownNameError
from wbc_bench.evaluation.evaluate import EvaluationError
from wbc_bench.results.analysis import collect
from wbc_bench.results.store import ResultStore

EPISODES = 60  # a whole shard and a short one


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> str:
    return str(write_tiny(tmp_path_factory.mktemp("tiny"), replicates=2, episodes=EPISODES))


class Counting:
    """Leans a little more in every step that it has ever taken: a copy that is used twice would show."""

    def __init__(self, robot=None, lean: float = 0.01) -> None:
        self.info = ControllerInfo("counting", frozenset({"proprioception"}), 0.02, "a test")
        self.q, self.lean, self.steps = wbc_bench.load_robot().default_q, lean, 0

    def reset(self, episodes, obs, target) -> None: ...

    def act(self, obs, target) -> JointCommand:
        self.steps += 1
        return JointCommand(np.tile(self.q, (len(obs.active), 1)) + self.lean * self.steps)


def test_importing_is_light_and_every_name_exists():
    code = "import sys, wbc_bench; print(*(m for m in ('numpy', 'mujoco', 'pandas') if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
    assert all(callable(getattr(wbc_bench, name)) for name in wbc_bench.__all__)
    with pytest.raises(AttributeError, match="valid: Controller"):
        _ = wbc_bench.evalute  # type: ignore[attr-defined]


def test_a_spec(tiny, tmp_path):
    results = wbc_bench.evaluate("hold", tiny, episodes=7, out=tmp_path)
    assert len(results.episodes) == 14 and len(results.records) == 2
    assert results.success.num_episodes == 14 and "| hold | 14/14 |" in str(results)
    assert (tmp_path / "runs" / "tiny" / "hold" / "replicate_1" / "run.json").exists()
    fewer = wbc_bench.evaluate("hold", tiny, episodes=3, replicates=1, out=tmp_path)
    assert fewer.episodes["episode"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("workers", [1, 2])
def test_objects_and_classes_give_the_same_rows_at_any_number_of_workers(tiny, workers):
    whole = wbc_bench.evaluate(Counting(), tiny, workers=workers)
    assert whole.episodes.equals(wbc_bench.evaluate(Counting, tiny).episodes)
    assert whole.records[0].controller == "counting"
    assert not whole.episodes.equals(wbc_bench.evaluate(Counting(lean=0.02), tiny).episodes)


def test_an_object_with_another_state_is_another_controller(tiny, tmp_path):
    wbc_bench.evaluate(Counting(), tiny, episodes=3, out=tmp_path)
    wbc_bench.evaluate(Counting(), tiny, episodes=3, out=tmp_path)
    with pytest.raises(StoreError, match="the code or the files of 'counting' were others"):
        wbc_bench.evaluate(Counting(lean=0.02), tiny, episodes=3, out=tmp_path)


def test_an_object_that_cannot_be_copied_says_what_to_hand_over(tiny):
    one = Counting()
    one.lock = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(ControllerError, match="hand over its class"):
        wbc_bench.evaluate(one, tiny)


def other_run(root: Path, replicate: int) -> Path:
    """The folder of a replicate of the only controller below a store."""
    (folder,) = (root / "runs" / "tiny").iterdir()
    return folder / f"replicate_{replicate}"


def test_swapped_weights_are_never_reused(tiny, tmp_path):
    """Neither those of a finished run, nor those of a replicate that another table row would pool."""
    spec = write_controller(
        tmp_path, "weighted", "q = q + float((Path(__file__).with_name('w')).read_text())"
    )
    file = tmp_path / "weighted.py"
    text = file.read_text().replace('"a test")', '"a test", files=(Path(__file__).with_name("w"),))')
    file.write_text(text)
    (tmp_path / "w").write_text("0.0")
    first = wbc_bench.evaluate(spec, tiny, episodes=3, replicates=1, out=tmp_path / "out")
    (tmp_path / "w").write_text("0.1")
    with pytest.raises(StoreError, match="--overwrite"):
        wbc_bench.evaluate(spec, tiny, episodes=3, replicates=1, out=tmp_path / "out")
    with pytest.raises(StoreError, match="--overwrite"):
        wbc_bench.evaluate(spec, tiny, episodes=3, replicates=2, out=tmp_path / "out")
    other = wbc_bench.evaluate(spec, tiny, episodes=3, replicates=2, out=tmp_path / "other")
    shutil.copytree(other_run(tmp_path / "other", 1), other_run(tmp_path / "out", 1))
    assert len(other.records) == 2
    with pytest.raises(StoreError, match=r"replicates 0 and 1 of .* different code or files"):
        collect(ResultStore(tmp_path / "out").runs("tiny"))
    again = wbc_bench.evaluate(spec, tiny, episodes=3, replicates=1, out=tmp_path / "out", overwrite=True)
    assert not again.episodes.equals(first.episodes)


def test_an_edited_file_is_imported_anew(tiny, tmp_path):
    spec = write_controller(tmp_path, "edited_twice", "pass")
    before = wbc_bench.evaluate(spec, tiny, episodes=3)
    write_controller(tmp_path, "edited_twice", "q = q + 0.2")
    assert not wbc_bench.evaluate(spec, tiny, episodes=3).episodes.equals(before.episodes)


def test_a_run_grows_to_the_bytes_of_a_whole_one(tiny, tmp_path):
    wbc_bench.evaluate("hold", tiny, episodes=50, out=tmp_path / "grown")
    grown = wbc_bench.evaluate("hold", tiny, out=tmp_path / "grown")
    whole = wbc_bench.evaluate("hold", tiny, out=tmp_path / "whole")
    assert [record.resumed_shards for record in grown.records] == [1, 1]
    assert [r.episodes_sha256 for r in grown.records] == [r.episodes_sha256 for r in whole.records]


def test_what_is_overwritten_stays_until_the_new_run_is_whole(tiny, tmp_path):
    spec = write_controller(
        tmp_path, "breaks", "if (Path(__file__).with_name('x')).exists(): raise KeyError('x')"
    )
    before = wbc_bench.evaluate(spec, tiny, episodes=3, out=tmp_path / "out").records
    (tmp_path / "x").touch()
    with pytest.raises(ControllerError, match="KeyError"):
        wbc_bench.evaluate(spec, tiny, episodes=3, out=tmp_path / "out", overwrite=True)
    (tmp_path / "x").unlink()
    assert wbc_bench.evaluate(spec, tiny, episodes=3, out=tmp_path / "out").records == before


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("if self.calls == 3: helper(q)", r"`act` at control step 2 of episodes \d+ to \d+: ZeroDivision"
         r"Error: .*\(faulty\d+\.py:\d+ in act > faulty\d+\.py:\d+ in helper\)"),
        ("return q", r"returned ndarray from `act`, valid: a wbc_bench\.controller\.JointCommand"),
        ("return None", "returned NoneType from `act`"),
        ("obs.privileged.friction", r"`info\.signals` does not declare is None"),
        ("raise SystemExit(0)", "SystemExit: 0"),
    ],
)  # fmt: skip
def test_a_fault_of_a_users_controller_is_one_line_with_its_own_frames(
    tiny, tmp_path, body, message, workers
):
    name = f"faulty{zlib.crc32(body.encode())}{workers}"
    spec = write_controller(tmp_path, name, body)
    with (tmp_path / f"{name}.py").open("a") as file:
        file.write("\ndef helper(q):\n    return 1 / 0\n")
    with pytest.raises(ControllerError, match=message) as caught:
        wbc_bench.evaluate(spec, tiny, workers=workers, out=tmp_path / "out")
    assert "\n" not in str(caught.value) and "wbc_bench/" not in str(caught.value)


def test_bad_arguments_are_one_line(tiny, tmp_path):
    with pytest.raises(EvaluationError, match="--episodes 0: valid: 1 to 60"):
        wbc_bench.evaluate("hold", tiny, episodes=0)
    with pytest.raises(EvaluationError, match="--replicates 3: valid: 1 to 2"):
        wbc_bench.evaluate("hold", tiny, replicates=3)
    with pytest.raises(UnknownNameError, match="valid: dask"):
        wbc_bench.evaluate("hold", tiny, engine="spark")
    with pytest.raises(UnknownNameError, match="did you mean ablation_v2"):
        wbc_bench.evaluate("hold", "ablation_v")
    with pytest.raises(BenchError, match="'---' cannot name a folder"):
        odd = Counting()
        odd.info = odd.info._replace(name="---")
        wbc_bench.evaluate(odd, tiny, episodes=1)


def test_odd_folders(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("~", "exp:1", "a b", "file:x"):
        results = wbc_bench.evaluate("hold", tiny, episodes=2, out=Path(folder) / "res")
        assert len(results.episodes) == 4 and (tmp_path / folder / "res" / "runs").is_dir()


def test_compare(tiny):
    a, b = (wbc_bench.evaluate(one, tiny, episodes=8) for one in ("hold", Counting()))
    table = wbc_bench.compare(a, b)
    assert "A = hold against B = counting" in table.title and table.rows[-1][1] == "16"
    with pytest.raises(UnknownNameError, match="smoke_v1"):
        wbc_bench.compare(a, wbc_bench.evaluate("hold", "smoke_v1", episodes=2))
