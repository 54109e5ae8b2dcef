"""Episodes as a LeRobot dataset: what it says is what the episodes were, by the published layout."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from commands import fails
from runs import evaluated
from wbc_bench.cli.main import main
from wbc_bench.errors import StoreError
from wbc_bench.results.lerobot import INDICES, POSE, Episode, write_dataset
from wbc_bench.results.store import Run
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.rotations import geodesic_angle
from wbc_bench.sources.recorded.files import load_recording
from wbc_bench.viewer.rerun import rerun

DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return evaluated(tmp_path_factory.mktemp("store"), "hold")


@pytest.fixture(scope="module")
def dataset(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "dataset"
    main(["export-dataset", str(run.path), "--episodes", "1", "0", "-o", str(folder)])
    return folder


def test_frames_are_those_of_the_episodes(run: Run, dataset: Path) -> None:
    frame = pq.read_table(dataset / DATA).to_pandas()
    for k, number in enumerate((1, 0)):
        moments, part = rerun(run, number).moments, frame[frame.episode_index == k]
        assert part.frame_index.tolist() == list(range(len(moments)))
        np.testing.assert_allclose(part.timestamp, [moment.time for moment in moments], atol=1e-5)
        pairs = (
            ("action", [moment.target_pos_w for moment in moments]),
            ("observation.ee_pose", [moment.ee_pos_w for moment in moments]),
            ("observation.base_pose", [moment.qpos[:3] for moment in moments]),
        )
        for name, pos in pairs:
            np.testing.assert_allclose(np.stack(part[name])[:, :3], pos, atol=1e-6)
        joints = np.array([moment.qpos[7:] for moment in moments])
        np.testing.assert_allclose(np.stack(part["observation.state"]), joints, atol=1e-5)
    assert frame["index"].tolist() == list(range(len(frame))) and set(frame.task_index) == {0}


def test_the_layout_is_the_published_one(run: Run, dataset: Path) -> None:
    """Every feature is in the data with its type and width; indices of episodes lead to their frames."""
    info, table = json.loads((dataset / "meta/info.json").read_text()), pq.read_table(dataset / DATA)
    assert info["codebase_version"] == "v3.0" and info["fps"] == 50 and info["total_episodes"] == 2
    assert info["total_frames"] == len(table) and info["splits"] == {"train": "0:2"}
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    assert set(info["features"]) == set(table.column_names) and set(INDICES) < set(table.column_names)
    for name, feature in info["features"].items():
        kind = table.schema.field(name).type
        width = feature["shape"][0]
        plain = pa.float32() if feature["dtype"] == "float32" else pa.int64()
        assert kind == (plain if feature["shape"] == [1] else pa.list_(plain, width)), name
        assert feature["names"] is None or len(feature["names"]) == width
    assert info["features"]["observation.state"]["names"] == list(JOINT_NAMES)
    episodes = pq.read_table(dataset / EPISODES).to_pandas()
    for row in episodes.itertuples():
        part = table.slice(row.dataset_from_index, row.length).to_pandas()
        assert set(part.episode_index) == {row.episode_index} and row.verified
    assert episodes.dataset_to_index.tolist() == np.cumsum(episodes.length).tolist()
    assert episodes.outcome.tolist() == run.episodes().outcome[[1, 0]].tolist()
    tasks = pd.read_parquet(dataset / "meta/tasks.parquet")
    assert tasks.task_index.tolist() == [0] and set(episodes.tasks[0]) == set(tasks.index)
    stats = json.loads((dataset / "meta/stats.json").read_text())
    hand = np.stack(table["observation.ee_pose"].to_numpy())
    np.testing.assert_allclose(stats["observation.ee_pose"]["mean"], hand.mean(axis=0), atol=1e-5)
    assert stats["action"]["count"] == [len(table)] and set(stats) == set(info["features"])


def test_a_dataset_is_a_source_of_targets(run: Run, dataset: Path) -> None:
    moments = rerun(run, 0).moments
    found = load_recording(f"{dataset}?episode=1&feature=observation.ee_pose")
    np.testing.assert_allclose(found.pos, [moment.ee_pos_w for moment in moments], atol=1e-6)
    assert geodesic_angle(found.rot, np.array([moment.ee_rot_w for moment in moments])).max() < 1e-5
    assert found.frame == "world"


def test_equal_episodes_give_equal_bytes_and_nothing_is_replaced(tmp_path: Path) -> None:
    part = Episode("move", {"action": np.ones((3, 7))}, {"success": True})
    for name in ("a", "b"):
        write_dataset(tmp_path / name, [part, part], {"action": POSE}, 50, "robot", {})
    files = [sorted(p.relative_to(tmp_path / n) for p in (tmp_path / n).rglob("*")) for n in ("a", "b")]
    assert files[0] == files[1] and len(files[0]) > 5
    for file in files[0]:
        if (tmp_path / "a" / file).is_file():
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    with pytest.raises(StoreError, match="exists"):
        write_dataset(tmp_path / "a", [part], {"action": POSE}, 50, "robot", {})
    with pytest.raises(StoreError, match="0 frames"):
        write_dataset(tmp_path / "c", [], {"action": POSE}, 50, "robot", {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_what_cannot_be_exported(run: Run, tmp_path: Path, capsys) -> None:
    out = tmp_path / "d"
    assert "each once" in fails(capsys, "export-dataset", run.path, "--episodes", 0, 0, "-o", out)
    assert "episode 99" in fails(capsys, "export-dataset", run.path, "--episodes", 99, "-o", out)
    assert not out.exists()


def test_their_own_loader_reads_it(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    loader = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    found = loader.LeRobotDataset("local/dataset", root=dataset)
    table = pq.read_table(dataset / DATA)
    assert found.num_episodes == 2 and found.num_frames == len(table)
    for k in (0, len(table) - 1):
        np.testing.assert_array_equal(found[k]["action"].numpy(), table["action"][k].as_py())
