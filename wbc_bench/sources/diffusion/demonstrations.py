"""Demonstrations on disk in UMI's zarr layout; README.md explains it field by field."""

import io
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError
from wbc_bench.files import write_atomic
from wbc_bench.rotations import matrix_from_rotvec, rotvec_from_matrix
from wbc_bench.sources.diffusion import poses
from wbc_bench.sources.diffusion.zarr_archive import MAX_ROWS, episode_slices, read_archive, zarr_module
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


# what is read: number of columns, 0 for (E,); start and end poses follow from the others
WANTED = {f"data/{name}": LAYOUT[name][0] for name in LAYOUT if not name.startswith("robot0_demo")}
WANTED["meta/episode_ends"] = 0
LARGEST = 1e3  # size of a number, [m] or [rad]; choice
LEAST_AREA = 0.5  # between two rows that should be at right angles; choice


class Demonstration(NamedTuple):
    """T control steps of one episode, poses of the hand in the world."""

    ee: Pose  # (T, 3) [m], (T, 3, 3)
    target: Pose  # (T, 3) [m], (T, 3, 3) what the expert asked for
    panel: Pose  # (T, 3) [m], (T, 3, 3) the door's frame
    angle: Array  # (T,) [rad]
    # (T, 2) [m] between the fingers, as it was and as asked for; None: fingers that stay at GRIPPER_WIDTH
    width: Array | None = None

    @property
    def widths(self) -> Array:
        """(T, 2) [m] between the fingers, as it was and as asked for."""
        return np.full((len(self.angle), 2), GRIPPER_WIDTH) if self.width is None else self.width


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

    Raises: SourceError when there is none, too many steps, or zarr is missing; StoreError.
    """
    zarr = zarr_module()
    steps = sum(len(episode.angle) for episode in episodes)
    if not 0 < steps <= MAX_ROWS:
        found = f"{steps} steps" if episodes else "no demonstration"
        raise SourceError(f"{found} to write to '{path}', valid: 1 to {MAX_ROWS} steps")
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
    """The demonstrations of a file of `demo record`, or of UMI's tools with `data/door_state` added.

    Without `data/action` the poses themselves are what is asked for, as UMI's sampler takes them.

    Raises: SourceError, see `read_archive`; or numbers that are none, lengths that differ, no rotation.
    """
    found = read_archive(path, WANTED, frozenset({"data/action"}))
    arrays = {name.removeprefix("data/"): value for name, value in found.arrays.items()}
    ends = arrays.pop("meta/episode_ends").astype(np.int64)
    arrays = {name: value.astype(float) for name, value in arrays.items()}
    if "action" not in arrays:
        parts = ("robot0_eef_pos", "robot0_eef_rot_axis_angle", "robot0_gripper_width")
        arrays["action"] = np.concatenate([arrays[name] for name in parts], axis=-1)
    slices = episode_slices(path, ends)
    _check(path, arrays, ends)
    episodes = [_demonstration({name: value[rows] for name, value in arrays.items()}) for rows in slices]
    return Demonstrations(episodes, found.attributes, found.sha256)


def _columns(episode: Demonstration) -> dict[str, Array]:
    """The arrays of one episode, (T, columns)."""
    ee, target = poses.tool(episode.ee), poses.tool(episode.target)
    count = len(episode.angle)
    axis_angle = np.concatenate([ee.pos, rotvec_from_matrix(ee.rot)], axis=-1)
    width, asked = np.split(episode.widths, 2, axis=-1)
    return {
        "robot0_eef_pos": axis_angle[:, :3],
        "robot0_eef_rot_axis_angle": axis_angle[:, 3:],
        "robot0_gripper_width": width,
        "robot0_demo_start_pose": np.tile(axis_angle[0], (count, 1)),
        "robot0_demo_end_pose": np.tile(axis_angle[-1], (count, 1)),
        "action": np.concatenate([target.pos, rotvec_from_matrix(target.rot), asked], axis=-1),
        "door_state": door_state(episode.panel, episode.angle, episode.ee),
    }


def _demonstration(arrays: dict[str, Array]) -> Demonstration:
    ee = Pose(arrays["robot0_eef_pos"], matrix_from_rotvec(arrays["robot0_eef_rot_axis_angle"]))
    action, door = arrays["action"], arrays["door_state"]
    panel = poses.absolute(poses.pose_of(door[:, : poses.POSE]), ee)
    target = Pose(action[:, :3], matrix_from_rotvec(action[:, 3:6]))
    width = np.concatenate([arrays["robot0_gripper_width"], action[:, 6:]], axis=-1)
    return Demonstration(poses.hand(ee), poses.hand(target), panel, door[:, -1], width)


def _check(path: Path, arrays: dict[str, Array], ends: NDArray[np.int64]) -> None:
    for name, value in arrays.items():
        where = f"demonstrations '{path}': data/{name}"
        if len(value) != ends[-1]:
            valid = f"{ends[-1]}, the last of meta/episode_ends"
            raise SourceError(f"{where} has {len(value)} rows, valid: {valid}")
        if not (np.abs(value) <= LARGEST).all():  # so written that NaN is refused
            raise SourceError(f"{where} holds a number that is not finite or beyond {LARGEST:g}")
    x, y = arrays["door_state"][:, 3:6], arrays["door_state"][:, 6:9]
    if not (np.linalg.norm(np.cross(x, y), axis=-1) > LEAST_AREA).all():
        where = f"demonstrations '{path}': columns 3 to 8 of data/door_state"
        raise SourceError(f"{where} are no rotation, valid: its first two rows")
