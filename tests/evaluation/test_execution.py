"""Who computes a shard changes nothing: bytes at any number of workers, after kills, and on a cluster."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tiny_protocol import write_tiny
from user_controllers import write_controller
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import read_protocol
from wbc_bench.errors import ControllerError, StoreError, UnknownNameError
from wbc_bench.evaluation import workers as workers_module
from wbc_bench.evaluation.execution import Job, run_jobs
from wbc_bench.evaluation.shard import evaluate_shard
from wbc_bench.evaluation.workers import Engine, ExecutionError
from wbc_bench.outcomes import Outcome
from wbc_bench.results.store import ResultStore

EPISODES = 120  # three shards, the last one short


# Driven by files beside the controller, so that spec, code and hence bytes stay the same.
STEERED = (
    "here = Path(__file__).parent",
    'if (here / "pause").exists():',
    "    time.sleep(0.02)",
    'if self.calls == 5 and (here / "kill").exists():',
    '    (here / "kill").unlink()',
    "    os.kill(os.getpid(), signal.SIGKILL)  # as the kernel does when memory runs out",
)


@contextlib.contextmanager
def steer(spec: str, name: str):
    """While it is open, the reference controller pauses at every step or kills its worker once."""
    file = Path(spec.partition(":")[0]).with_name(name)
    file.touch()
    try:
        yield file
    finally:
        file.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("tiny"), replicates=2, episodes=EPISODES)


def job(path: Path, spec: str, replicates: int = 1, episodes: int = EPISODES) -> Job:
    protocol = read_protocol(path)
    manifest, sha256 = read_manifest(protocol, manifest_path(path))
    return Job(protocol, manifest, sha256, spec, range(replicates), episodes)


def record_bytes(root: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(root.glob("runs/*/*/*/episodes.parquet"))]


@pytest.fixture(scope="module")
def reference(tiny, tmp_path_factory) -> tuple[str, list[bytes]]:
    """A noisy, feeding-back controller and the bytes of its records from one process."""
    folder = tmp_path_factory.mktemp("reference")
    spec = write_controller(folder, "reference_controller", *STEERED)
    run_jobs([job(tiny, spec, 2)], ResultStore(folder), Engine())
    return spec, record_bytes(folder)


def test_two_workers_give_the_bytes_of_one(tiny, reference, tmp_path):
    spec, expected = reference
    runs = run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), Engine(workers=2))
    assert len(runs) == 2 and all(run.record.completed == EPISODES for run in runs)
    assert record_bytes(tmp_path) == expected


def test_a_shard_does_not_depend_on_the_others(tiny, reference, tmp_path):
    """The first 50 episodes asked for alone are the first 50 of all."""
    spec, _ = reference
    (run,) = run_jobs([job(tiny, spec, episodes=50)], ResultStore(tmp_path), Engine())
    frame = run.episodes()
    whole = ResultStore(Path(spec.partition(":")[0]).parent).load("tiny", spec)
    assert frame.equals(whole.iloc[:50])


def test_nothing_is_computed_twice(tiny, reference, tmp_path, monkeypatch, capsys):
    spec, _ = reference
    run_jobs([job(tiny, spec)], ResultStore(tmp_path), Engine())
    monkeypatch.setattr(workers_module, "evaluate_shard", None)
    run_jobs([job(tiny, spec)], ResultStore(tmp_path), Engine())
    assert "reused" in capsys.readouterr().err


def test_a_killed_worker_costs_only_time(tiny, reference, tmp_path):
    spec, expected = reference
    with steer(spec, "kill") as kill:
        run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), Engine(workers=2))
        assert not kill.exists()
    assert record_bytes(tmp_path) == expected


def test_a_shard_that_always_kills_ends_in_an_error(tiny, tmp_path):
    spec = write_controller(tmp_path, "always_dies", "os.kill(os.getpid(), signal.SIGKILL)")
    with pytest.raises(ExecutionError, match="3 times in a row"):
        run_jobs([job(tiny, spec)], ResultStore(tmp_path / "out"), Engine(workers=2))
    assert not list((tmp_path / "out").rglob("*.parquet"))


@pytest.mark.parametrize("workers", [1, 2])
def test_sigkill_of_everything_then_resume(tiny, reference, tmp_path, workers):
    spec, expected = reference
    command = [sys.executable, "-m", "wbc_bench", "eval", "--controller", spec, "--protocol", str(tiny)]
    command += ["--workers", str(workers), "--out", str(tmp_path)]
    with steer(spec, "pause"):
        process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
        try:
            deadline = time.monotonic() + 60
            while len(list(tmp_path.rglob("shard_*.parquet"))) < 2:
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.01)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    kept = len(list(tmp_path.rglob("shard_*.parquet")))
    assert 2 <= kept < 6
    assert ResultStore(tmp_path).unfinished()
    runs = run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), Engine(workers=workers))
    assert sum(run.record.resumed_shards for run in runs) == kept
    assert record_bytes(tmp_path) == expected
    assert not list(tmp_path.rglob("shard_*")) and not list(tmp_path.rglob("*.tmp"))


def test_workers_leave_when_their_client_is_killed(tiny, reference, tmp_path):
    """The kernel may kill the client alone; nothing must go on computing, or hold memory, without it."""
    spec, _ = reference
    command = [sys.executable, "-m", "wbc_bench", "eval", "--controller", spec, "--protocol", str(tiny)]
    command += ["--workers", "2", "--out", str(tmp_path)]
    with steer(spec, "pause"):
        process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while not list(tmp_path.rglob("shard_*.parquet")):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        process.kill()
        process.wait()
        deadline = time.monotonic() + 20
        with pytest.raises(ProcessLookupError):  # until the whole process group is empty
            while time.monotonic() < deadline:
                os.killpg(process.pid, 0)
                time.sleep(0.1)
    # and the lock of the run went with the client
    run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), Engine())


def test_dask_cluster_with_a_worker_killed_midway(tiny, reference, tmp_path):
    distributed = pytest.importorskip("distributed")
    spec, expected = reference
    with (
        steer(spec, "kill") as kill,
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        engine = Engine.parse(f"dask={cluster.scheduler_address}", workers=1)
        run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), engine)
        assert not kill.exists()
    assert record_bytes(tmp_path) == expected


def test_dask_starts_its_own_cluster(tiny, reference, tmp_path):
    pytest.importorskip("distributed")
    spec, expected = reference
    run_jobs([job(tiny, spec, 2)], ResultStore(tmp_path), Engine.parse("dask", workers=1))
    assert record_bytes(tmp_path) == expected


def test_a_dask_cluster_has_no_web_server():
    """What listens are scheduler, worker and nanny, for this machine alone; a dashboard would be more."""
    distributed = pytest.importorskip("distributed")
    import psutil

    from wbc_bench.evaluation.dask_cluster import local_cluster

    def listening() -> set[tuple[str | int, ...]]:
        own = psutil.Process()
        found = [
            c for process in (own, *own.children(recursive=True)) for c in process.net_connections("inet")
        ]
        return {tuple(c.laddr) for c in found if c.status == psutil.CONN_LISTEN}

    before = listening()
    with local_cluster(1) as cluster, distributed.Client(cluster) as client:
        client.wait_for_workers(1, timeout=30)
        info = client.scheduler_info()
        (address, worker), *others = info["workers"].items()
        assert worker["nthreads"] == 1 and not others
        addresses = (info["address"], address, worker["nanny"])
        known = {("127.0.0.1", int(address.rpartition(":")[2])) for address in addresses}
        assert listening() - before == known and len(known) == 3


def test_no_scheduler_at_the_address(tiny, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers_module, "CONNECT_TIMEOUT", 0.3)
    with pytest.raises(ExecutionError, match="no dask scheduler answers at 'tcp:"):
        run_jobs([job(tiny, "hold")], ResultStore(tmp_path), Engine.parse("dask=tcp://127.0.0.1:9", 1))


@pytest.mark.parametrize("text", ["spark", "loky=here", "daks"])
def test_unknown_engine(text):
    with pytest.raises(UnknownNameError, match="engine"):
        Engine.parse(text, 1)


def test_nan_makes_an_episode_invalid_and_the_rest_go_on(tiny, tmp_path):
    spec = write_controller(
        tmp_path, "sometimes_nan", "if self.calls == 4:", "    q[self.episodes % 10 == 3] = np.nan"
    )
    (run,) = run_jobs([job(tiny, spec)], ResultStore(tmp_path), Engine())
    frame = run.episodes()
    invalid = frame["outcome"] == Outcome.INVALID
    np.testing.assert_array_equal(invalid, frame["episode"] % 10 == 3)
    assert run.record.outcomes["invalid"] == EPISODES // 10
    assert sum(run.record.outcomes.values()) == run.record.completed == EPISODES
    assert (frame.loc[invalid, "steps"] == 3).all()
    assert (frame.loc[~invalid, "steps"] == 10).all()


@pytest.mark.parametrize("workers", [1, 2])
def test_wrong_shape_names_the_expected_one(tiny, tmp_path, workers):
    spec = write_controller(tmp_path, f"wrong_shape{workers}", "q = q[:, :8]")
    with pytest.raises(ControllerError, match=r"\(50, 8\), expected \(50, 14\)"):
        run_jobs([job(tiny, spec)], ResultStore(tmp_path / "out"), Engine(workers=workers))
    assert not list((tmp_path / "out").rglob("*.parquet"))


def test_changed_code_does_not_join_old_shards(tiny, tmp_path):
    """Shards of a controller that was edited in between are refused, not merged."""
    spec = write_controller(tmp_path, "edited", "pass")
    store = ResultStore(tmp_path / "out")
    stop = iter(range(10))
    original = workers_module.evaluate_shard

    def interrupted(*arguments):
        if next(stop) == 1:
            raise KeyboardInterrupt
        return original(*arguments)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(workers_module, "evaluate_shard", interrupted)
        run_jobs([job(tiny, spec)], store, Engine())
    assert store.unfinished()[0][1] == 1
    write_controller(tmp_path, "edited", "q = q + 0.1")
    with pytest.raises(StoreError, match="software_sha256"):
        run_jobs([job(tiny, spec)], store, Engine())
    run_jobs([job(tiny, spec)], store, Engine(), overwrite=True)
    assert store.runs()[0].record.resumed_shards == 0


def test_columns_of_the_record(tiny):
    from wbc_bench.results.metrics import METRICS

    protocol = read_protocol(tiny)
    manifest, _ = read_manifest(protocol, manifest_path(tiny))
    table = evaluate_shard("hold", protocol, manifest.take(slice(0, 3)))
    labels = ["replicate", "episode", "stratum", "condition", "orientation", "height", "target_x", "target_y"]
    assert table.column_names == [*labels, "outcome", "steps", *(metric.name for metric in METRICS)]
    np.testing.assert_allclose(table["target_x"], manifest.target_pos_w[:3, 0])
