"""Poses of named columns: what CSV, parquet and LeRobot have in common."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_rpy, matrix_from_wxyz
from wbc_bench.sources.interface import UNIT_TOLERANCE
from wbc_bench.sources.recorded.recording import LARGEST

Array = NDArray[np.float64]
POSITION = ("x", "y", "z")  # [m]
QUATERNION = ("qw", "qx", "qy", "qz")
ROTATIONS = (  # one of these names the rotation: quaternion, rotation vector [rad], angles of URDF [rad]
    QUATERNION,
    ("rx", "ry", "rz"),
    ("roll", "pitch", "yaw"),
)
TIMES = ("t", "time", "timestamp")  # [s]
VALID = f"{', '.join(POSITION)} and one of " + "; ".join(", ".join(names) for names in ROTATIONS)


def rotation_of(names: Sequence[str]) -> tuple[str, ...] | None:
    """The columns that name the rotation, where a position is there too; None where it is no pose."""
    present = [rotation for rotation in ROTATIONS if set(rotation) <= set(names)]
    return present[0] if len(present) == 1 and set(POSITION) <= set(names) else None


def pose_columns(names: Sequence[str], where: str) -> tuple[str, ...]:
    """Names of the columns that hold a pose. Raises: SourceError, they do not, or two rotations are there."""
    rotation = rotation_of(names)
    if rotation is None:
        raise SourceError(f"{where} has columns {', '.join(names)[:500] or 'none'}, valid: {VALID}")
    return (*POSITION, *rotation)


def poses_of(columns: Mapping[str, Array], where: str) -> tuple[Array, Array]:
    """Positions (T, 3) [m] and rotations (T, 3, 3) of the columns that `pose_columns` names, (T,) each.

    Raises: SourceError, a number is not finite or too large, or a quaternion is not nearly unit.
    """
    names = pose_columns(list(columns), where)
    values = np.stack([columns[name] for name in names], axis=1)
    if not (np.abs(values) <= LARGEST).all():  # so written that NaN is refused
        bad = names[int(np.argmin((np.abs(values) <= LARGEST).all(axis=0)))]
        raise SourceError(f"{where}: column {bad} holds a number that is not finite or beyond {LARGEST:g}")
    pos, turns = values[:, :3], values[:, 3:]
    if names[3:] == QUATERNION:
        norms = np.linalg.norm(turns, axis=1)
        if not (np.abs(norms - 1) <= UNIT_TOLERANCE).all():
            worst = float(norms[np.abs(norms - 1).argmax()])
            raise SourceError(
                f"{where}: a quaternion has norm {worst:.4g}, valid: 1 within {UNIT_TOLERANCE:g}"
            )
        return pos, matrix_from_wxyz(turns / norms[:, None])
    return pos, matrix_from_rotvec(turns) if names[3] == "rx" else matrix_from_rpy(turns)
