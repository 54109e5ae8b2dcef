"""Sound recordings of an end effector in every kind of file, and their readers."""

import pickle
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zarr

from wbc_bench.results.lerobot import POSE, Episode, write_dataset
from wbc_bench.sources.recorded.files import load_recording

COUNT = 20
POSES = np.column_stack([np.linspace(0, 1, 3 * COUNT).reshape(COUNT, 3), np.tile([1.0, 0, 0, 0], (COUNT, 1))])
TABLE = dict(zip(POSE, POSES.T, strict=True))


def write_recordings(folder: Path) -> None:
    lines = [
        ",".join(("t", *POSE)),
        *(",".join(f"{v:.4f}" for v in (k, *row)) for k, row in enumerate(POSES)),
    ]
    (folder / "a.csv").write_text("# frame=world\n# tool=ee\n" + "\n".join(lines) + "\n")
    said = {"rate": "50", "frame": "start", "tool": "umi"}
    pq.write_table(pa.table(TABLE).replace_schema_metadata(said), folder / "a.parquet")
    pos, turns = POSES[:, :3], POSES[:, 4:]
    episodes = [{"ee_pos": pos, "ee_axis_angle": turns, "t": 1.5}, {"ee_pos": pos, "ee_axis_angle": turns}]
    for protocol in (2, 4, 5):
        (folder / f"{protocol}.pkl").write_bytes(pickle.dumps(episodes, protocol))
    entries = {}
    root = zarr.create_group(store=zarr.storage.MemoryStore(entries), zarr_format=2)  # pyright: ignore[reportArgumentType]
    root.attrs.update({"control_period": 0.02})
    arrays = {"data/robot0_eef_pos": pos, "data/robot0_eef_rot_axis_angle": turns}
    for name, value in (arrays | {"meta/episode_ends": np.array([5, COUNT])}).items():
        root.create_array(name, data=value)
    with zipfile.ZipFile(folder / "a.zarr.zip", "w") as archive:
        for name, value in entries.items():
            archive.writestr(name, value.to_bytes())
    parts = [Episode("move", {"action": POSES}, {"success": True}) for _ in range(2)]
    write_dataset(folder / "dataset", parts, {"action": POSE}, 50, "robot", {"frame": "world", "tool": "ee"})


def read_recordings(folder: Path) -> None:
    names = ["a.csv", "a.parquet", "a.zarr.zip?episode=1", "dataset?episode=1"]
    for name in (*names, *(f"{protocol}.pkl?episode=1&frame=start" for protocol in (2, 4, 5))):
        found = load_recording(f"{folder}/{name}")
        assert (
            np.isfinite(found.pos).all() and np.isfinite(found.rot).all() and (np.diff(found.time) > 0).all()
        )
