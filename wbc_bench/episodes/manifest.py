"""The frozen manifest: one row an episode, holding every draw that the episode needs."""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import ManifestError

# Column of the file for a field of another name: frozen manifests keep their bytes.
_COLUMNS = {"feasible_qpos": "witness_qpos"}


@dataclass(frozen=True)
class EpisodeManifest:
    """Columns of M episodes, in the order (replicate, episode)."""

    replicate: NDArray[np.int64]  # (M,)
    episode: NDArray[np.int64]  # (M,) number inside the replicate
    stratum: NDArray[np.object_]  # (M,) arm, posture, step; beyond: no feasible pose is known
    condition: NDArray[np.object_]  # (M,) "", nominal, randomised
    orientation: NDArray[np.object_]  # (M,) "", free, horizontal
    height: NDArray[np.float64]  # (M,) [m] nominal target height (reach), else the target's
    target_pos_w: NDArray[np.float64]  # (M, 3) [m]
    target_quat_w: NDArray[np.float64]  # (M, 4) wxyz
    # (M, 21) a feasible configuration that reaches the target; NaN if beyond
    feasible_qpos: NDArray[np.float64]
    base_height: NDArray[np.float64]  # (M,) [m] at reset: the lower sole touches the ground
    friction: NDArray[np.float64]  # (M,)
    base_mass: NDArray[np.float64]  # (M,) [kg] added
    base_vel: NDArray[np.float64]  # (M, 6) linear in the world [m/s], angular in the base [rad/s]
    leg_q: NDArray[np.float64]  # (M, 8) [rad] added to the default posture at reset
    leg_qd: NDArray[np.float64]  # (M, 8) [rad/s]
    kp_scale: NDArray[np.float64]  # (M, 14)
    kd_scale: NDArray[np.float64]  # (M, 14)
    push_time: NDArray[np.float64]  # (M, MAX_PUSHES) [s], NaN for none
    push_vel: NDArray[np.float64]  # (M, 2 * MAX_PUSHES) [m/s] x, y of each, in the world
    noise_key: NDArray[np.int64]  # (M,) seed of the episode's noise stream
    noise_scale: NDArray[np.float64]  # (M,) 0 or 1 on the protocol's noise

    def __len__(self) -> int:
        return len(self.replicate)

    def take(self, rows: NDArray[np.int64] | slice) -> "EpisodeManifest":
        """The chosen rows."""
        return EpisodeManifest(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def of_replicate(self, replicate: int, count: int | None = None) -> "EpisodeManifest":
        """The first `count` (default all) episodes of a replicate."""
        return self.take(np.flatnonzero(self.replicate == replicate)[:count])


def manifest_path(protocol_path: Path) -> Path:
    """Where the manifest of a protocol file stands: beside it."""
    return protocol_path.with_suffix(".parquet")


def write_manifest(manifest: EpisodeManifest, protocol: EvalProtocol, path: Path) -> None:
    """Write a manifest with its protocol's digest; equal manifests give equal bytes."""
    arrays, names = [], []
    for field in fields(manifest):
        value = getattr(manifest, field.name)
        if value.ndim == 2:
            flat = pa.array(np.ascontiguousarray(value).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, value.shape[1]))
        else:
            arrays.append(pa.array(value.tolist(), pa.string()) if value.dtype == object else pa.array(value))
        names.append(_column(field.name))
    table = pa.Table.from_arrays(arrays, names=names)
    table = table.replace_schema_metadata({"protocol": protocol.name, "protocol_digest": protocol.digest})
    pq.write_table(table, path, compression="zstd", use_dictionary=False)


def read_manifest(protocol: EvalProtocol, path: Path) -> tuple[EpisodeManifest, str]:
    """The manifest of a protocol and the SHA-256 of its file.

    Raises:
        ManifestError: missing, unreadable, made for another protocol, or altered since it was frozen.
    """
    if not path.exists():
        raise ManifestError(
            f"manifest '{path}' does not exist: make it with `wbc-bench protocol freeze {protocol.name}`"
        )
    data = path.read_bytes()
    sha256 = hashlib.sha256(data).hexdigest()
    recorded_file = path.with_suffix(".sha256")
    recorded = recorded_file.read_text().split()[0] if recorded_file.exists() else "none recorded"
    if recorded != sha256:
        raise ManifestError(
            f"manifest '{path}' does not match its hash: it has {sha256[:16]}..., "
            f"{recorded_file.name} says {recorded[:16]}..."
        )
    try:
        table = pq.read_table(pa.BufferReader(data))
    except pa.ArrowException as error:
        raise ManifestError(f"manifest '{path}' is not readable parquet: {error}") from error
    made_for = (table.schema.metadata or {}).get(b"protocol_digest", b"").decode()
    if made_for != protocol.digest:
        raise ManifestError(
            f"manifest '{path}' was made for protocol digest {made_for[:16] or 'none'}..., "
            f"the protocol {protocol.name} has {protocol.digest[:16]}...: freeze it again"
        )
    columns = {}
    for field in fields(EpisodeManifest):
        column = table[_column(field.name)].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            columns[field.name] = column.flatten().to_numpy().reshape(-1, column.type.list_size)
        else:
            columns[field.name] = column.to_numpy(zero_copy_only=False)
    return EpisodeManifest(**columns), sha256


def _column(field: str) -> str:
    """Name in the file of a field of the manifest."""
    return _COLUMNS.get(field, field)
