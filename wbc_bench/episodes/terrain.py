"""Uneven ground: one field of bumps, the same in all episodes; each episode begins elsewhere on it."""

from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.randomness import stream

Array = NDArray[np.float64]
CELL = 0.05  # [m] between two heights: a third of a sole's length, so that soles stand on edges and corners
HALF = 5.0  # [m] half an edge of the square field
TERRAIN_SPAN = 3.0  # [m] an episode begins within this of the middle, and has 2 m to move
_DEPTH = 0.5  # [m] of the ground below the lowest point


@cache
def heights() -> Array:
    """Relative heights (R, R) in 0..1, rows along y; an arbitrary but fixed draw."""
    count = round(2 * HALF / CELL) + 1
    return stream(0, "terrain_heights").uniform(0, 1, (count, count))


def uneven(spec: mujoco.MjSpec, step_height: float) -> None:
    """Replace the plane of a robot's editable model by the field, up to `step_height` [m] above z = 0."""
    field = heights()
    spec.add_hfield(
        name="ground",
        nrow=len(field),
        ncol=len(field),
        size=[HALF, HALF, step_height, _DEPTH],
        userdata=field.ravel(),
    )
    ground = spec.geom("ground")
    ground.type = mujoco.mjtGeom.mjGEOM_HFIELD
    ground.hfieldname = "ground"


def highest_near(points: Array, step_height: float, offset: Array | None) -> Array:
    """Heights (K,) [m], none of which the bumps within a cell of the points (K, 3) [m] exceed.

    Args:
        points: in the frame of the ground, z along its normal.
        step_height: of the field [m].
        offset: where the field's middle lies (2,) [m].
    """
    if step_height == 0:
        return np.zeros(len(points))
    place = (points[:, :2] - (0.0 if offset is None else offset) + HALF) / CELL
    column, row = np.floor(place).astype(int).T
    field = heights()
    near = [field[row + i, column + j] for i in range(-1, 3) for j in range(-1, 3)]
    return step_height * np.max(near, axis=0)
