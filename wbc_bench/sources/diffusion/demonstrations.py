"""Demonstrations on disk in UMI's zarr layout; README.md explains it field by field."""

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError, missing_extra
from wbc_bench.files import write_atomic
from wbc_bench.rotations import matrix_from_rotvec, rotvec_from_matrix
from wbc_bench.sources.diffusion import poses
from wbc_bench.sources.slew import Pose

Array = NDArray[np.float64]
GRIPPER_WIDTH = 0.078  # [m] between the fingers of the facts file, which do not move
DOOR = 10  # numbers of a door: its pose and its angle
LAYOUT = {  # array -> (columns, type)
    "robot0_eef_pos": (3, "<f4"),
    "robot0_eef_rot_axis_angle": (3, "<f4"),
    "robot0_gripper_width": (1, "<f4"),
    "robot0_demo_start_pose": (6, "<f8"),
    "robot0_demo_end_pose": (6, "<f8"),
    "action": (7, "<f4"),
    "door_state": (DOOR, "<f4"),
}
EPOCH = (1980, 1, 1, 0, 0, 0)  # of every zip entry: equal demonstrations are equal bytes


class Demonstration(NamedTuple):
    """T control steps of one episode, poses of the hand in the world."""

    ee: Pose  # (T, 3) [m], (T, 3, 3)
    target: Pose  # (T, 3) [m], (T, 3, 3) what the expert asked for
    panel: Pose  # (T, 3) [m], (T, 3, 3) the door's frame
    angle: Array  # (T,) [rad]


class Demonstrations(NamedTuple):
    """A file of them."""

    episodes: list[Demonstration]
    attributes: dict[str, Any]  # what the recorder says of them
    sha256: str


def door_state(panel: Pose, angle: Array, ee: Pose) -> Array:
    """What a policy sees of a door: (..., 10), the panel as seen from UMI's tool frame [m], angle [rad]."""
    seen = poses.numbers(poses.relative(panel, poses.tool(ee)))
    return np.concatenate([seen, np.asarray(angle)[..., None]], axis=-1)


def write_demonstrations(path: Path, episodes: list[Demonstration], attributes: dict[str, Any]) -> None:
    """Write a zip of zarr version 2, uncompressed; equal demonstrations give equal bytes.

    Raises: SourceError when there is none, or zarr is missing; StoreError.
    """
    zarr = _zarr()
    if not episodes:
        raise SourceError(f"no demonstration to write to '{path}'")
    parts = [_columns(episode) for episode in episodes]
    entries: dict[str, Any] = {}
    root = zarr.create_group(store=zarr.storage.MemoryStore(entries), zarr_format=2)
    root.attrs.update(attributes)
    data, meta = root.create_group("data"), root.create_group("meta")
    arrays = [
        (data, name, np.concatenate([part[name] for part in parts]).astype(kind))
        for name, (_, kind) in LAYOUT.items()
    ]
    arrays.append((meta, "episode_ends", np.cumsum([len(e.angle) for e in episodes]).astype("<i8")))
    for group, name, value in arrays:
        group.create_array(name, data=value, chunks=value.shape, compressors=None, filters=None)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in sorted(entries):
            archive.writestr(zipfile.ZipInfo(name, EPOCH), entries[name].to_bytes())
    write_atomic(path, file.getvalue())


def read_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations of a file.

    Raises: SourceError when it is missing, no zip of zarr, or an array is missing, of another shape, or not
    finite.
    """
    zarr = _zarr()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"demonstrations '{path}' cannot be read: {error.strerror}") from error
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            broken = archive.testzip()  # zarr takes a damaged chunk as it is
        if broken is not None:
            raise ValueError(f"checksum of '{broken}'")
        store = zarr.storage.ZipStore(path, mode="r")
        try:
            root = zarr.open_group(store, mode="r", zarr_format=2)
            arrays = {name: np.asarray(root[f"data/{name}"][:], dtype=float) for name in LAYOUT}
            ends = np.asarray(root["meta/episode_ends"][:])
            attributes = dict(root.attrs)
        finally:
            store.close()
    except (zipfile.BadZipFile, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise SourceError(f"demonstrations '{path}' are damaged, valid: a zarr v2 zip: {error}") from error
    _check(path, arrays, ends)
    parts = [
        _demonstration({name: value[start:end] for name, value in arrays.items()})
        for start, end in zip([0, *ends[:-1]], ends, strict=True)
    ]
    return Demonstrations(parts, attributes, hashlib.sha256(data).hexdigest())


def _columns(episode: Demonstration) -> dict[str, Array]:
    """The arrays of one episode, (T, columns)."""
    ee, target = poses.tool(episode.ee), poses.tool(episode.target)
    count = len(episode.angle)
    axis_angle = np.concatenate([ee.pos, rotvec_from_matrix(ee.rot)], axis=-1)
    width = np.full((count, 1), GRIPPER_WIDTH)
    return {
        "robot0_eef_pos": axis_angle[:, :3],
        "robot0_eef_rot_axis_angle": axis_angle[:, 3:],
        "robot0_gripper_width": width,
        "robot0_demo_start_pose": np.tile(axis_angle[0], (count, 1)),
        "robot0_demo_end_pose": np.tile(axis_angle[-1], (count, 1)),
        "action": np.concatenate([target.pos, rotvec_from_matrix(target.rot), width], axis=-1),
        "door_state": door_state(episode.panel, episode.angle, episode.ee),
    }


def _demonstration(arrays: dict[str, Array]) -> Demonstration:
    ee = Pose(arrays["robot0_eef_pos"], matrix_from_rotvec(arrays["robot0_eef_rot_axis_angle"]))
    action, door = arrays["action"], arrays["door_state"]
    panel = poses.absolute(poses.pose_of(door[:, : poses.POSE]), ee)
    target = Pose(action[:, :3], matrix_from_rotvec(action[:, 3:6]))
    return Demonstration(poses.hand(ee), poses.hand(target), panel, door[:, -1])


def _check(path: Path, arrays: dict[str, Array], ends: NDArray[np.int64]) -> None:
    whole = len(ends) > 0 and ends[0] > 0 and bool((np.diff(ends) > 0).all())
    if ends.ndim != 1 or ends.dtype.kind not in "iu" or not whole:
        raise SourceError(f"demonstrations '{path}': meta/episode_ends must rise from above 0")
    for name, value in arrays.items():
        shape = (int(ends[-1]), LAYOUT[name][0])
        if value.shape != shape:
            raise SourceError(f"demonstrations '{path}': data/{name} has shape {value.shape}, valid: {shape}")
        if not np.isfinite(value).all():
            raise SourceError(f"demonstrations '{path}': data/{name} holds a number that is not finite")


def _zarr() -> Any:
    try:
        import zarr
        import zarr.storage
    except ImportError as error:
        raise SourceError(missing_extra("a file of demonstrations", "diffusion", error)) from error
    return zarr
