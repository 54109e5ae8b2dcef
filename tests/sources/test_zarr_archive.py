"""Files of demonstrations as other programs make them, sound and not; none takes more memory than stated."""

import json
import pickle
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest

from commands import fails
from wbc_bench.errors import SourceError
from wbc_bench.sources.diffusion import zarr_archive
from wbc_bench.sources.diffusion.demonstrations import (
    Demonstration,
    read_demonstrations,
    write_demonstrations,
)
from wbc_bench.sources.diffusion.training import stride_of, train, windows
from wbc_bench.sources.slew import Pose
from zarr_files import STEPS, recorded, write


def described(name: str, **fields: Any) -> Callable[[dict[str, bytes]], None]:
    """Change what an array says of itself."""

    def change(entries: dict[str, bytes]) -> None:
        file = f"{name}/.zarray"
        entries[file] = json.dumps(json.loads(entries[file]) | fields).encode()

    return change


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"packed": numcodecs.Blosc("zstd", shuffle=numcodecs.Blosc.BITSHUFFLE)},  # as UMI packs for disks
        {"packed": numcodecs.Blosc("lz4", 5), "chunks": (7, 1)},
        {"method": zipfile.ZIP_DEFLATED},
        {"ends": np.array([30, 60], np.uint64)},
    ],
    ids=["plain", "blosc", "small chunks", "deflated", "unsigned"],
)
def test_what_umi_tools_write_is_read(tmp_path: Path, how: dict[str, Any]) -> None:
    arrays = recorded()
    found = read_demonstrations(write(tmp_path / "d.zarr.zip", arrays, **how))
    assert [len(episode.angle) for episode in found.episodes] == [30, 30]
    hand = np.concatenate([episode.ee.pos for episode in found.episodes])
    np.testing.assert_array_equal(hand, arrays["robot0_eef_pos"])


def test_without_actions_the_poses_are_what_was_asked_for(tmp_path: Path) -> None:
    """And neither pictures nor start and end poses are needed or looked at."""
    arrays = recorded()
    for name in ("action", "robot0_demo_start_pose", "robot0_demo_end_pose"):
        del arrays[name]
    arrays["camera0_rgb"] = np.zeros((STEPS, 2), np.uint8)
    path = write(
        tmp_path / "d.zarr.zip", arrays, change=described("data/camera0_rgb", compressor={"id": "jpegxl"})
    )
    for episode in read_demonstrations(path).episodes:
        np.testing.assert_array_equal(episode.target.pos, episode.ee.pos)
        np.testing.assert_array_equal(episode.widths[:, 0], episode.widths[:, 1])


def test_a_recording_of_umi_says_what_it_lacks(capsys, tmp_path: Path) -> None:
    arrays = recorded()
    del arrays["action"], arrays["door_state"]
    line = fails(
        capsys, "demo", "train", write(tmp_path / "d.zarr.zip", arrays), "-o", tmp_path / "p.safetensors"
    )
    assert "have no array data/door_state" in line and "found: data/robot0_demo_end_pose" in line
    assert "damaged" not in line


def test_a_gripper_that_moves_is_learned(tmp_path: Path) -> None:
    """Its width comes back from a file, and is in what the policy sees and in what it says."""
    episode = read_demonstrations(write(tmp_path / "d.zarr.zip", recorded())).episodes[0]
    wide = episode._replace(width=np.stack([np.linspace(0.08, 0.0, 30), np.linspace(0.07, 0.01, 30)], axis=1))
    write_demonstrations(tmp_path / "e.zarr.zip", [wide], {})
    (back,) = read_demonstrations(tmp_path / "e.zarr.zip").episodes
    np.testing.assert_allclose(back.widths, wide.widths, atol=1e-7)
    data = windows([back], 0.1, np.random.default_rng(0))
    looks = data.looks.double().numpy().reshape(3, 30, 2, -1)
    np.testing.assert_allclose(looks[:, :, 1, 9], np.tile(wide.widths[:, 0], (3, 1)), atol=1e-6)
    chunks = data.chunks.double().numpy().reshape(3, 30, 16, -1)
    np.testing.assert_allclose(chunks[0, 5, :, 9], wide.widths[5:21, 1], atol=1e-6)


@pytest.mark.parametrize(("period", "stride"), [(0.1, 1), (0.05, 2), (0.02, 5), (1 / 60, 6), (1 / 59.94, 6)])
def test_periods_that_fit(period: float, stride: int) -> None:
    assert stride_of(period) == stride


@pytest.mark.parametrize(
    "period", [0.07, 0.04, 0.2, 1, 0.0, -0.02, np.nan, np.inf, 1e-300, None, "0.02", [0.02]]
)
def test_periods_that_do_not_fit_are_refused(tmp_path: Path, period: Any) -> None:
    """0.07 s was taken for 0.1 s: everything that was learned went by at 1.4 times its speed."""
    attributes = {} if period is None else {"control_period": period}
    path = write(tmp_path / "d.zarr.zip", recorded(), attributes=attributes)
    with pytest.raises(SourceError, match=r"attribute control_period is .*valid: 0\.1 s or a whole part"):
        train(path, 0, 1)


def bomb(entries: dict[str, bytes]) -> None:
    """Zeros that would take gigabytes, in a few kilobytes."""
    described("data/action", shape=[200_000_000, 7], chunks=[200_000_000, 7])(entries)


def deep_bomb(entries: dict[str, bytes]) -> None:
    """A modest array whose chunk unpacks to more than it says."""
    packer = numcodecs.Blosc("zstd", 9)
    described("data/action", compressor=packer.get_config())(entries)
    entries["data/action/0.0"] = packer.encode(np.zeros(1 << 26, np.uint8))  # pyright: ignore[reportArgumentType]


def code(entries: dict[str, bytes]) -> None:
    described("data/action", filters=[{"id": "pickle", "protocol": 5}])(entries)
    entries["data/action/0.0"] = pickle.dumps(np.zeros(7))


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"ends": np.int64(60)}, "meta/episode_ends has shape (), valid: (E,)"),
        ({"ends": [[30], [60]]}, "meta/episode_ends has shape (2, 1), valid: (E,)"),
        ({"ends": [30.0, 60.0]}, "meta/episode_ends has numbers of type <f8, valid: integers"),
        ({"ends": np.array([60, 30], np.uint64)}, "meta/episode_ends must rise"),
        ({"ends": np.array([], np.int64)}, "meta/episode_ends must rise"),
        ({"ends": [30, 50]}, "has 60 rows, valid: 50, the last of meta/episode_ends"),
        ({"form": 3}, "are of zarr version 3, valid: version 2"),
        ({"change": bomb}, "data/action has shape (200000000, 7), valid: (T, 7) of at most 1000000 rows"),
        ({"change": described("data/action", chunks=[1 << 40, 7])}, "has chunks (1099511627776, 7)"),
        ({"change": described("data/action", shape=[10**6, 7], chunks=[1, 1])}, "7000000 chunks"),
        ({"change": deep_bomb}, "data/action/0.0 unpacks to 67108864 bytes, valid: 1680"),
        ({"change": code}, "data/action/.zarray"),
        ({"change": described("data/action", dtype="|O")}, "has numbers of type |O"),
        ({"change": described("data/action", compressor={"id": "zlib", "level": 1})}, "'zlib'"),
        ({"change": described("data/action", shape=[60, 8])}, "data/action has shape (60, 8), valid: (T, 7)"),
        ({"change": described("data/action", shape=[-60, 7])}, "data/action/.zarray"),
        ({"change": lambda e: e.update({"data/action/.zarray": b"[" * 5000})}, "data/action/.zarray"),
        ({"change": lambda e: e.update({".zattrs": b" " * (2 << 20)})}, "'.zattrs' has 2097152 bytes"),
    ],
)
def test_what_is_not_read_is_one_line(capsys, tmp_path: Path, how: dict[str, Any], said: str) -> None:
    path, out = write(tmp_path / "d.zarr.zip", recorded(), **how), tmp_path / "p.safetensors"
    line = fails(capsys, "demo", "train", path, "-o", out)
    assert str(path) in line and said in line and not out.exists()


@pytest.mark.parametrize("seed", range(20))
def test_a_deflated_zip_with_damaged_bytes_is_one_line(tmp_path: Path, seed: int) -> None:
    path = write(tmp_path / "d.zarr.zip", recorded(), method=zipfile.ZIP_DEFLATED)
    data, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    start = data.find(b"robot0_eef_pos/0.0") + 40 + int(rng.integers(200))
    data[start : start + 15] = bytes(15)
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"d\.zarr\.zip"):
        read_demonstrations(path)


def test_a_zip_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path: Path) -> None:
    """600 MB of zeros as one chunk in less than a megabyte: nothing of it is unpacked."""
    path, zeros = tmp_path / "d.zarr.zip", bytes(1 << 20)
    write(path, recorded(), method=zipfile.ZIP_DEFLATED)
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open(zipfile.ZipInfo("data/action/1.0"), "w", force_zip64=True) as file,
    ):
        for _ in range(600):
            file.write(zeros)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # [KiB]
    with pytest.raises(SourceError, match=r"data/action/1\.0 unpacks to 629145600 bytes, valid: 1680"):
        read_demonstrations(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10


def test_all_that_is_read_has_a_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(zarr_archive, "MAX_UNPACKED", 1000)
    with pytest.raises(SourceError, match="bytes to read, valid: at most 1000"):
        read_demonstrations(write(tmp_path / "d.zarr.zip", recorded()))


@pytest.mark.parametrize("columns", [[0, 0, 0, 0, 1, 0], [1, 0, 0, 1, 0, 0]])
def test_a_door_without_a_rotation_is_refused(tmp_path: Path, columns: list[int]) -> None:
    arrays = recorded()
    arrays["door_state"][7, 3:9] = columns
    with pytest.raises(SourceError, match="columns 3 to 8 of data/door_state are no rotation"):
        read_demonstrations(write(tmp_path / "d.zarr.zip", arrays))


def test_more_than_can_be_read_is_not_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("wbc_bench.sources.diffusion.demonstrations.MAX_ROWS", 5)
    still = Pose(np.zeros((6, 3)), np.tile(np.eye(3), (6, 1, 1)))
    with pytest.raises(SourceError, match=r"6 steps to write to .*valid: 1 to 5 steps"):
        write_demonstrations(tmp_path / "d.zarr.zip", [Demonstration(still, still, still, np.zeros(6))], {})
