"""Recorded trajectories of every kind of file: the same poses, what must be named, and nothing executed."""

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr

from commands import fails
from robot_states import seen_at
from wbc_bench.cli.main import main
from wbc_bench.errors import BenchError, SourceError
from wbc_bench.evaluation.tracking import natural_duration
from wbc_bench.results.lerobot import POSE, Episode, write_dataset
from wbc_bench.results.tracking import read_tracks
from wbc_bench.rotations import (
    geodesic_angle,
    matrix_from_rotvec,
    matrix_from_rpy,
    matrix_from_wxyz,
    rotvec_from_matrix,
    rpy_from_matrix,
    wxyz_from_matrix,
)
from wbc_bench.sources import load_source, to_world
from wbc_bench.sources.adapters import EE_FROM_UMI_TCP
from wbc_bench.sources.recorded import array_pickle
from wbc_bench.sources.recorded.files import load_recording
from wbc_bench.sources.recorded.recording import RecordedSource

RATE = 50.0  # [Hz]
TIME = np.arange(100) / RATE  # [s]
POS = np.stack([0.4 + 0.1 * np.sin(TIME), 0.1 * TIME, 0.9 + 0.05 * np.cos(TIME)], axis=1)  # [m]
ROT = matrix_from_rpy(np.stack([0.1 * TIME, 0.3 * np.sin(TIME), 0.2 * TIME], axis=1))
TOOL_ROT = ROT @ EE_FROM_UMI_TCP  # the same hand in the axes of UMI's tool


def columns(rotation: str = "quaternion") -> dict[str, np.ndarray]:
    turns = {
        "quaternion": (("qw", "qx", "qy", "qz"), wxyz_from_matrix(ROT)),
        "vector": (("rx", "ry", "rz"), rotvec_from_matrix(ROT)),
        "angles": (("roll", "pitch", "yaw"), rpy_from_matrix(ROT)),
    }
    names, values = turns[rotation]
    return dict(zip(("x", "y", "z", *names), np.column_stack([POS, values]).T, strict=True))


def episodes() -> list[dict[str, Any]]:
    """As UMI-on-Legs pickles them: the second is the one above."""
    one = {"t": TIME, "ee_pos": POS, "ee_axis_angle": rotvec_from_matrix(TOOL_ROT), "gripper_width": TIME}
    return [{name: value + 1 for name, value in one.items()}, one]


def write_csv(path: Path, table: dict[str, np.ndarray], head: str = "") -> Path:
    path.write_text(head + pd.DataFrame(table).to_csv(index=False))
    return path


def write_zarr(path: Path, **attributes: float) -> Path:
    entries: dict[str, Any] = {}
    root = zarr.create_group(store=zarr.storage.MemoryStore(entries), zarr_format=2)  # pyright: ignore[reportArgumentType]
    root.attrs.update(attributes)
    root.create_array("data/robot0_eef_pos", data=np.concatenate([POS + 1, POS]))
    turns = rotvec_from_matrix(TOOL_ROT)
    root.create_array("data/robot0_eef_rot_axis_angle", data=np.concatenate([turns, turns]))
    root.create_array("meta/episode_ends", data=np.array([100, 200]))
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in entries.items():
            archive.writestr(name, value.to_bytes())
    return path


def write_lerobot(folder: Path, **about: str) -> Path:
    pose = np.column_stack([POS, wxyz_from_matrix(ROT)])
    parts = [
        Episode("move", {"action": pose + k * (np.arange(7) < 3), "other": pose[:, :2]}, {})
        for k in (1.0, 0.0)
    ]
    write_dataset(folder, parts, {"action": POSE, "other": ("a", "b")}, int(RATE), "robot", about)
    return folder


def pickled(path: Path, value: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(value, protocol))
    return path


# the same poses


@pytest.mark.parametrize("kind", ["quaternion", "vector", "angles", "parquet", "zarr", "pickle", "lerobot"])
def test_every_kind_of_file_gives_the_same_poses(tmp_path: Path, kind: str) -> None:
    query = "?frame=world&tool=ee&rate=50"
    if kind == "parquet":
        path = tmp_path / "a.parquet"
        pq.write_table(pa.table(columns()), path)
    elif kind == "zarr":
        path, query = write_zarr(tmp_path / "a.zarr.zip"), "?frame=world&rate=50&episode=1"
    elif kind == "pickle":
        path, query = pickled(tmp_path / "a.pkl", episodes()), "?frame=world&rate=50&episode=1"
    elif kind == "lerobot":
        path, query = write_lerobot(tmp_path / "a"), "?frame=world&tool=ee&episode=1"
    else:
        path = write_csv(tmp_path / "a.csv", columns(kind))
    found = load_recording(f"{path}{query}")
    np.testing.assert_allclose(found.pos, POS, atol=1e-7)
    assert geodesic_angle(found.rot, ROT).max() < 1e-6
    np.testing.assert_allclose(found.time, TIME, atol=1e-12)
    assert found.frame == "world"


def test_a_file_may_name_what_its_poses_mean(tmp_path: Path) -> None:
    found = load_recording(
        str(write_csv(tmp_path / "a.csv", columns(), "# rate=50\n# frame=base\n# tool=umi\n"))
    )
    assert found.frame == "base" and found.duration == pytest.approx(99 / RATE)
    assert geodesic_angle(found.rot @ EE_FROM_UMI_TCP, ROT).max() < 1e-6
    table = pa.table(columns() | {"t": TIME}).replace_schema_metadata({"frame": "world", "tool": "ee"})
    pq.write_table(table, tmp_path / "a.parquet")
    assert load_recording(str(tmp_path / "a.parquet")).frame == "world"
    assert load_recording(f"{tmp_path / 'a.parquet'}?frame=start").frame == "start"
    assert load_recording(str(write_zarr(tmp_path / "a.zarr.zip", control_period=0.02))).frame == "world"
    said = load_recording(str(write_lerobot(tmp_path / "a", frame="base", tool="ee")))
    assert said.frame == "base" and said.duration == pytest.approx(99 / RATE)


def test_a_digest_is_of_all_that_decides_the_targets(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns())
    digests = {
        load_recording(f"{path}?{query}").digest
        for query in (
            "frame=world&tool=ee&rate=50",
            "frame=base&tool=ee&rate=50",
            "frame=world&tool=umi&rate=50",
            "frame=world&tool=ee&rate=25",
        )
    }
    assert len(digests) == 4
    again = load_recording(f"{path}?rate=50&tool=ee&frame=world")
    assert again.digest in digests


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", ["<f8", "<f4", ">f8", "<i4"])
def test_arrays_of_a_pickle_are_those_of_pickle(tmp_path: Path, protocol: int, kind: str) -> None:
    rng = np.random.default_rng(0)
    sound = [np.array(100 * rng.normal(size=shape)).astype(kind) for shape in ((3, 4), (2, 3, 5), (0, 3), ())]
    sound += [np.asfortranarray(sound[0]), sound[0][::2]]
    value = [sound, {"a": 1.5, "b": [1, -(2**40), None, True, "ü"], "c": np.float64(2.5)}]
    found = array_pickle.load(pickled(tmp_path / "a.pkl", value, protocol))
    for want, got in zip(sound, found[0], strict=True):
        np.testing.assert_array_equal(array_pickle.array(got, tmp_path, "it"), want)
    assert found[1] == value[1]


# what is played


def test_a_recording_is_played_at_its_pace(tmp_path: Path) -> None:
    """A line leads to it, then its poses come at its times, and the last one stays."""
    path = write_csv(tmp_path / "a.csv", columns() | {"t": 5.0 + TIME})
    source = load_source(f"{path}?frame=world&tool=ee")
    assert isinstance(source, RecordedSource)
    seen = seen_at(0.0, (0.0, 0.0, 0.8))
    source.reset(seen)
    begin = source.path.duration - TIME[-1]
    first = to_world(source.target(0.0, seen), seen)
    np.testing.assert_allclose(first[0], seen.ee_pos_w, atol=1e-12)
    for k in (0, 1, 57, 99):
        pos, rot = to_world(source.target(begin + TIME[k], seen), seen)
        np.testing.assert_allclose(pos, POS[k], atol=1e-9)
        assert geodesic_angle(rot, ROT[k]) < 1e-6
    between = source.target(begin + 0.5 * (TIME[3] + TIME[4]), seen)
    np.testing.assert_allclose(between.pos, (POS[3] + POS[4]) / 2, atol=1e-9)
    np.testing.assert_allclose(source.target(1e6, seen).pos, POS[-1])


def test_from_the_start_it_begins_at_the_hand_and_stays_level(tmp_path: Path) -> None:
    """Turned about the vertical only: heights above the first pose, and what is left of its tilt, stay."""
    path = write_csv(tmp_path / "a.csv", columns())
    seen = seen_at(2.0, (1.0, -3.0, 0.8))
    source = load_source(f"{path}?frame=start&tool=ee&rate=50")
    source.reset(seen)
    begin = source.path.duration - TIME[-1]
    poses = [to_world(source.target(begin + time, seen), seen) for time in TIME]
    pos, rot = (np.array(values) for values in zip(*poses, strict=True))
    np.testing.assert_allclose(pos[0], seen.ee_pos_w, atol=1e-9)
    np.testing.assert_allclose(pos[:, 2] - pos[0, 2], POS[:, 2] - POS[0, 2], atol=1e-9)
    np.testing.assert_allclose(rot[:, 2], ROT[:, 2], atol=1e-6)  # z of the world in the hand
    angles = [
        geodesic_angle(matrix_from_rotvec(np.array([0.0, 0.0, turn])) @ rot[0], seen.ee_rot_w)
        for turn in (-0.01, 0.0, 0.01)
    ]
    assert np.argmin(angles) == 1


def test_how_long_a_recording_lasts(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns())
    assert natural_duration(load_source(f"{path}?frame=start&tool=ee&rate=50")) == 4.0  # 1.98 s and 2 s
    with pytest.raises(SourceError, match=r"lasts .* valid: at most 598 s"):
        natural_duration(load_source(f"{path}?frame=start&tool=ee&rate=0.1"))


def test_track_follows_a_recording(tmp_path: Path, capsys) -> None:
    path = write_csv(tmp_path / "wave.csv", columns())
    source = f"{path}?frame=start&tool=ee&rate=50"
    main(
        ["track", "--controller", "hold", "--source", source, "--duration", "1", "--out", str(tmp_path / "o")]
    )
    (track,) = read_tracks(tmp_path / "o")
    digest = load_recording(source).digest
    assert track.record.source == f"wave@{digest[:8]}" and track.record.source_sha256 == digest


# what is refused


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("", "does not name rate, frame, tool: append"),
        ("?frame=world&tool=ee", "does not name rate: append"),
        ("?frame=word", "unknown frame 'word'"),
        ("?fram=world", "did you mean frame"),
        ("?rate=0", "rate"),
        ("?rate=fast", "rate"),
        ("?rate=nan&frame=world&tool=ee", "rate"),
        ("?rate", "key=value"),
        ("?rate=1&rate=2", "once"),
        ("?episode=1", "one episode"),
        ("?feature=a", "LeRobot"),
    ],
)
def test_what_a_name_must_say(tmp_path: Path, query: str, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        load_recording(f"{write_csv(tmp_path / 'a.csv', columns())}{query}")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": np.where(TIME > 1, np.nan, 0.0)}, "column x holds a number"),
        ({"y": np.full(100, 2e3)}, "column y holds a number"),
        ({"qw": np.full(100, 0.5)}, "norm"),
        ({"t": np.zeros(100)}, "do not rise"),
        ({"t": np.where(TIME > 1, np.inf, TIME)}, "not finite"),
        ({"t": TIME, "time": TIME}, "one of them"),
        ({"rx": TIME, "ry": TIME, "rz": TIME}, "valid: x, y, z and one of"),
        ({"x": np.array(["a"] * 100)}, "cannot be read"),
    ],
)
def test_columns_that_are_no_poses(tmp_path: Path, change: dict[str, np.ndarray], words: str) -> None:
    path = write_csv(tmp_path / "a.csv", columns() | change)
    rate = "" if "t" in change else "&rate=50"
    with pytest.raises(SourceError, match=words):
        load_recording(f"{path}?frame=world&tool=ee{rate}")


class Evil:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_of_a_pickle_is_executed(tmp_path: Path, capsys) -> None:
    mark = tmp_path / "executed"
    for k, value in enumerate(([Evil(mark)], [{"ee_pos": Evil(mark)}], {Evil(mark): 1})):
        path = pickled(tmp_path / f"{k}.pkl", value)
        line = fails(capsys, "track", "--controller", "hold", "--source", f"{path}?frame=world")
        assert "which is not called here" in line
    assert not mark.exists()
    pickle.loads((tmp_path / "0.pkl").read_bytes())  # what the file would have done
    assert mark.exists()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (pickle.dumps([np.array([None])]), "none of an array"),
        (pickle.dumps([np.array(["a"])]), "plain ones"),
        (pickle.dumps([{1, 2}]), "opcode"),
        (pickle.dumps([[{(1, 2): 3}]]), "neither texts nor integers"),
        (b"\x80\x04" + b"]" * 1_100_000 + b".", "opcodes"),
        (b"\x80\x04" + b"]" + b"\x85" * 900_000 + b"\x8c\x01aK\x01s.", "cannot be read"),
        (b"\x80\x04]r\xff\xff\xff\xff.", "list of dicts"),  # a memo of 4 G places
        (b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x00.", "cannot be read"),  # bytes of 64 PB
        (b"\x80\x04h\x05.", "cannot be read"),
        (b"", "cannot be read"),
    ],
)
def test_odd_pickles_are_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=words) as raised:
        value = array_pickle.load(path)
        if isinstance(value, list) and value:
            array_pickle.array(value[0], path, "it")
        load_recording(f"{path}?frame=world")
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 1000


def test_a_pickle_claims_no_more_than_it_holds(tmp_path: Path) -> None:
    path = pickled(tmp_path / "a.pkl", [np.zeros((2, 3))])
    path.write_bytes(path.read_bytes().replace(b"K\x02K\x03\x86", b"J\xff\xff\xff\x7fK\x03\x86"))
    (found,) = array_pickle.load(path)
    with pytest.raises(SourceError, match="not of its shape"):
        array_pickle.array(found, path, "it")


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("?frame=world&tool=ee&episode=2", "no episode 2, valid: 0 to 1"),
        ("?frame=world&tool=ee&feature=actio", "did you mean action"),
        ("?frame=world&tool=ee&feature=other", "names a, b, valid"),
        ("?tool=ee", "does not name frame"),
    ],
)
def test_what_a_dataset_must_have(tmp_path: Path, query: str, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        load_recording(f"{write_lerobot(tmp_path / 'a')}{query}")


def test_a_dataset_leads_to_no_file_of_its_own_choice(tmp_path: Path) -> None:
    """Its templates of paths are not used."""
    folder = write_lerobot(tmp_path / "a", frame="world", tool="ee")
    info = folder / "meta/info.json"
    info.write_text(info.read_text().replace("data/chunk", "../../elsewhere/chunk"))
    np.testing.assert_allclose(load_recording(f"{folder}?episode=1").pos, POS, atol=1e-7)
    info.write_text(info.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(SourceError, match=r"version 'v2\.1', valid: v3\.0"):
        load_recording(str(folder))


@pytest.mark.parametrize("name", ["none.csv", "no/such", "none.zarr.zip", "folder.csv", "a.pkl"])
def test_files_that_are_not_there(tmp_path: Path, name: str, capsys) -> None:
    (tmp_path / "folder.csv").mkdir()
    line = fails(capsys, "track", "--controller", "hold", "--source", tmp_path / name)
    assert name in line


def test_quaternions_are_scalar_first(tmp_path: Path) -> None:
    """By hand: 90 degrees about z is (cos 45, 0, 0, sin 45)."""
    half = np.sqrt(0.5)
    table = {"x": 1, "y": 2, "z": 3, "qw": half, "qx": 0, "qy": 0, "qz": half}
    path = write_csv(tmp_path / "a.csv", {name: np.array([value]) for name, value in table.items()})
    found = load_recording(f"{path}?frame=world&tool=ee&rate=1")
    np.testing.assert_allclose(found.rot[0] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(matrix_from_wxyz(np.array([half, 0, 0, half])), found.rot[0], atol=1e-12)
