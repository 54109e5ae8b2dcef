"""Demonstrations as other programs write them."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from wbc_bench.sources.diffusion.demonstrations import LAYOUT

STEPS = 60
Arrays = dict[str, np.ndarray]


def recorded() -> Arrays:
    """Numbers of no meaning, 60 steps of every array."""
    rng = np.random.default_rng(0)
    arrays = {name: (0.1 * rng.normal(size=(STEPS, c))).astype(kind) for name, (c, kind) in LAYOUT.items()}
    arrays["door_state"][:, 3:9] = [1, 0, 0, 0, 1, 0]
    arrays["robot0_gripper_width"][:, 0] = np.linspace(0.08, 0.0, STEPS)
    return arrays


def write(
    path: Path,
    arrays: Arrays,
    ends: Any = (30, STEPS),
    attributes: dict[str, Any] | None = None,
    form: int = 2,
    packed: Any = None,
    method: int = zipfile.ZIP_STORED,
    chunks: tuple[int, int] | None = None,
    change: Callable[[dict[str, bytes]], None] = lambda entries: None,
) -> Path:
    """A zip of zarr with arrays below data/ and ends of episodes below meta/; `change` alters its entries."""
    entries: dict[str, Any] = {}
    root = zarr.create_group(store=zarr.storage.MemoryStore(entries), zarr_format=form)  # pyright: ignore[reportArgumentType]
    root.attrs.update({"control_period": 0.02} if attributes is None else attributes)
    for name, value in arrays.items():
        root.create_array(
            f"data/{name}",
            data=value,
            chunks=chunks or value.shape,
            compressors=packed if form == 2 else "auto",
        )
    ends = np.asarray(ends)
    root.create_array("meta/episode_ends", data=ends, chunks=tuple(max(n, 1) for n in ends.shape) or "auto")
    data = {name: value.to_bytes() for name, value in entries.items()}
    change(data)
    with zipfile.ZipFile(path, "w", method) as archive:
        for name in sorted(data):
            archive.writestr(name, data[name])
    return path
