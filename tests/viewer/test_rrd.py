"""Recordings of Rerun and LeRobot datasets, read back by Rerun's own loaders."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

from commands import fails
from runs import evaluated
from wbc_bench.cli.main import main
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.results.store import Run
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.rotations import matrix_from_wxyz
from wbc_bench.viewer.moment import METRES_A_NEWTON, Skeleton
from wbc_bench.viewer.rerun import Rerun, rerun
from wbc_bench.viewer.rrd import write_rrd
from wbc_bench.viewer.time_line import events_of

chunk = pytest.importorskip("rerun.chunk")
experimental = pytest.importorskip("rerun.experimental")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return evaluated(tmp_path_factory.mktemp("store"), "hold")


@pytest.fixture(scope="module")
def again(run: Run) -> Rerun:
    return rerun(run, 1)


def columns_of(stream: Any) -> dict[str, list[Any]]:
    """`entity column` -> its values in order of time, but for what is static; the clock as `entity time`."""
    found: dict[str, list[Any]] = {}
    for part in stream.to_chunks():
        if not part.is_static:
            table = part.to_record_batch()
            for name, values in zip(table.schema.names, table.columns, strict=True):
                found.setdefault(f"{part.entity_path} {name}", []).extend(values.to_pylist())
    return found


def static_of(stream: Any) -> dict[str, set[str]]:
    """Entity -> names of its columns, of what is static."""
    found: dict[str, set[str]] = {}
    for part in stream.to_chunks():
        if part.is_static:
            found.setdefault(part.entity_path, set()).update(part.to_record_batch().schema.names)
    return found


@pytest.fixture(scope="module")
def recording(again: Rerun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("out") / "episode.rrd"
    write_rrd(again, path)
    assert [file.name for file in path.parent.iterdir()] == ["episode.rrd"]
    return path


@pytest.fixture(scope="module")
def columns(recording: Path) -> dict[str, list[Any]]:
    return columns_of(chunk.RrdReader(recording).stream())


def test_poses_forces_and_curves_are_those_of_the_episode(
    again: Rerun, columns: dict[str, list[Any]]
) -> None:
    moments = again.moments

    def vectors(name: str) -> np.ndarray:
        return np.array([value[0] for value in columns[name]])

    for entity, pos in (("/target", "target_pos_w"), ("/hand", "ee_pos_w")):
        wanted = np.array([getattr(moment, pos) for moment in moments])
        np.testing.assert_allclose(vectors(f"{entity} Transform3D:translation"), wanted, atol=1e-6)
    turned = matrix_from_wxyz(np.roll(vectors("/hand Transform3D:quaternion"), 1, axis=1))
    np.testing.assert_allclose(turned, [moment.ee_rot_w for moment in moments], atol=1e-6)
    force = np.array([moment.foot_force_w[0] for moment in moments])
    np.testing.assert_allclose(vectors("/force/left Arrows3D:vectors"), force * METRES_A_NEWTON, atol=1e-5)
    for name, values in (
        ("/error/position_cm", [moment.position_error * CM for moment in moments]),
        ("/error/orientation_deg", [moment.orientation_error * DEG for moment in moments]),
        (f"/joint/{JOINT_NAMES[3]}", [moment.qpos[10] for moment in moments]),
    ):
        np.testing.assert_allclose(vectors(f"{name} Scalars:scalars"), values, rtol=1e-12)
    clock = np.array([time.total_seconds() for time in columns["/hand time"]])
    np.testing.assert_allclose(clock, [moment.time for moment in moments], atol=1e-6)


def test_bodies_are_where_the_engine_has_them(again: Rerun, columns: dict[str, list[Any]]) -> None:
    skeleton = Skeleton(again.robot.model())
    k = len(again.moments) // 2
    skeleton.place(again.moments[k])
    for body in range(1, skeleton.model.nbody):
        name = f"/robot/{skeleton.model.body(body).name} Transform3D"
        np.testing.assert_allclose(columns[f"{name}:translation"][k][0], skeleton.data.xpos[body], atol=1e-6)
        x, y, z, w = columns[f"{name}:quaternion"][k][0]
        rot = np.empty(9)
        mujoco.mju_quat2Mat(rot, np.array([w, x, y, z]))
        np.testing.assert_allclose(rot, skeleton.data.xmat[body], atol=1e-6)


def test_every_shape_and_event_is_there(again: Rerun, recording: Path, columns: dict[str, list[Any]]) -> None:
    model, static = again.robot.model(), static_of(chunk.RrdReader(recording).stream())
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom]:
            name = f"/robot/{model.body(model.geom_bodyid[geom]).name}/{model.geom(geom).name}"
            assert any("half_sizes" in part or "lengths" in part for part in static[name]), name
    assert [text[0] for text in columns["/events TextLog:text"]] == [event.text for event in events_of(again)]
    assert any("TextDocument" in part for part in static["/about"])


def test_the_command_writes_a_recording(run: Run, tmp_path: Path, capsys) -> None:
    path = tmp_path / "it.rrd"
    main(["replay", str(run.path), "--episode", "0", "-o", str(path)])
    assert "verified: all" in capsys.readouterr().out
    assert chunk.RrdReader(path).recordings()
    line = fails(capsys, "replay", str(run.path), "--episode", 0, "-o", tmp_path / "it.mp4")
    assert "valid: a file that ends in .html or .rrd" in line


def test_a_folder_that_cannot_be_written_is_one_line(run: Run, tmp_path: Path, capsys) -> None:
    (tmp_path / "file").write_text("")
    fails(capsys, "replay", str(run.path), "--episode", 0, "-o", tmp_path / "file" / "it.rrd")
    assert (tmp_path / "file").read_text() == ""


def test_a_dataset_is_read_by_another_loader_of_the_format(run: Run, tmp_path: Path) -> None:
    """Every number comes back at its frame."""
    folder, numbers = tmp_path / "dataset", [5, 0, 1, 2, 3, 4]
    main(["export-dataset", str(run.path), "--episodes", *map(str, numbers), "-o", str(folder)])
    reader = experimental.LeRobotReader(folder)
    assert reader.version == "v3" and list(reader.episodes()) == list(range(len(numbers)))
    for k, number in enumerate(numbers[:2]):
        moments, found = rerun(run, number).moments, columns_of(reader.stream(k))
        for entity, wanted in (
            ("/observation.state", [moment.qpos[7:] for moment in moments]),
            ("/observation.foot_force", [moment.foot_force_w.ravel() for moment in moments]),
            ("/action", [[*moment.target_pos_w] for moment in moments]),
        ):
            values = np.array(found[f"{entity} Scalars:scalars"])
            np.testing.assert_allclose(values[:, : len(wanted[0])], wanted, rtol=1e-6, atol=1e-6)


def test_a_filmed_dataset_has_a_picture_for_every_frame(run: Run, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    try:
        main(
            ["export-dataset", str(run.path), "--episodes", "1", "0", "--video", "-o", str(tmp_path / "set")]
        )
    except SystemExit:
        pytest.skip("no OpenGL to draw with")
    name = "observation.images.scene"
    film = tmp_path / "set" / f"videos/{name}/chunk-000/file-000.mp4"
    lengths = [len(rerun(run, number).moments) for number in (1, 0)]
    assert ffmpeg.count_frames_and_secs(str(film))[0] == sum(lengths)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"][name]["shape"] == [240, 320, 3] and info["video_path"]
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    ends = [row[f"videos/{name}/to_timestamp"] for row in episodes]
    np.testing.assert_allclose(ends, np.cumsum(lengths) / 50)
    assert [row[f"videos/{name}/from_timestamp"] for row in episodes] == [0.0, ends[0]]
    # by a second reader of the film: the mean colour of what was filmed is that of the statistics
    pictures = np.stack(
        [
            np.frombuffer(data, np.uint8).reshape(240, 320, 3)
            for data in list(ffmpeg.read_frames(str(film), pix_fmt="rgb24"))[1:]
        ]
    )
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())[name]
    mean = np.reshape(stats["mean"], 3)
    np.testing.assert_allclose(pictures.mean(axis=(0, 1, 2)) / 255, mean, atol=0.01)
    assert np.shape(stats["q50"]) == (3, 1, 1) and np.shape(episodes[0][f"stats/{name}/std"]) == (3, 1, 1)
    reader = experimental.LeRobotReader(tmp_path / "set")
    for k, length in enumerate(lengths):
        found = columns_of(reader.stream(k))
        samples = found[next(key for key in found if "VideoStream:sample" in key)]
        assert len(samples) == length and all(len(sample[0]) > 50 for sample in samples)
