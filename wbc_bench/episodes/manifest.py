"""The frozen manifest: one row an episode, holding every draw that the episode needs."""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol
from wbc_bench.errors import ManifestError
from wbc_bench.robot import NUM_JOINTS, load_robot

# Column of the file for a field of another name: frozen manifests keep their bytes.
_COLUMNS = {"feasible_qpos": "witness_qpos"}
# Robot of the files that name none: they are older than robots' digests, and all of the default one.
FIRST_ROBOT = "48400a5d91d46b753bce351b4f6a990fa7bf5a82477d97946413a111328421c0"


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
    # Later columns, constant through an episode; a file without them means no such disturbance.
    push_vel_z: NDArray[np.float64]  # (M, MAX_PUSHES) [m/s]
    push_ang_vel: NDArray[np.float64]  # (M, 3 * MAX_PUSHES) [rad/s] in the base
    command_delay: NDArray[np.float64]  # (M,) [s]
    observation_delay: NDArray[np.float64]  # (M,) [s]
    odometry_delay: NDArray[np.float64]  # (M,) [s]
    odometry_drift: NDArray[np.float64]  # (M,) [m/sqrt(s)]
    payload: NDArray[np.float64]  # (M,) [kg]
    payload_offset: NDArray[np.float64]  # (M, 3) [m] in the end-effector frame
    motor_strength: NDArray[np.float64]  # (M,) factor on the torque limits
    joint_offset: NDArray[np.float64]  # (M, 14) [rad] measured less true
    imu_tilt: NDArray[np.float64]  # (M, 2) [rad] rotation vector in the base, x and y
    slope: NDArray[np.float64]  # (M, 2) [rad] rotation vector of the ground, x and y
    terrain_offset: NDArray[np.float64]  # (M, 2) [m] where on the uneven ground

    def __len__(self) -> int:
        return len(self.replicate)

    def take(self, rows: NDArray[np.int64] | slice) -> "EpisodeManifest":
        """The chosen rows."""
        return EpisodeManifest(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def of_replicate(self, replicate: int, count: int | None = None) -> "EpisodeManifest":
        """The first `count` (default all) episodes of a replicate."""
        return self.take(np.flatnonzero(self.replicate == replicate)[:count])


def neutral(count: int) -> dict[str, NDArray[np.float64]]:
    """The later columns (`count`, ...) of episodes without any of the disturbances that they hold."""
    widths = {"push_vel_z": MAX_PUSHES, "push_ang_vel": 3 * MAX_PUSHES, "joint_offset": NUM_JOINTS}
    widths |= {"payload_offset": 3, "imu_tilt": 2, "slope": 2, "terrain_offset": 2}
    scalars = ("command_delay", "observation_delay", "odometry_delay", "odometry_drift", "payload")
    columns = {name: np.zeros((count, width)) for name, width in widths.items()}
    columns |= {name: np.zeros(count) for name in scalars}
    return columns | {"motor_strength": np.ones(count)}


def manifest_path(protocol_path: Path) -> Path:
    """Where the manifest of a protocol file stands: beside it."""
    return protocol_path.with_suffix(".parquet")


def write_manifest(manifest: EpisodeManifest, protocol: EvalProtocol, path: Path) -> None:
    """Write a manifest with its protocol's digest; equal manifests give equal bytes."""
    arrays, names = [], []
    absent = neutral(len(manifest))
    for field in fields(manifest):
        value = getattr(manifest, field.name)
        if field.name in absent and np.array_equal(value, absent[field.name]):
            continue  # files from before the column existed keep their bytes
        if value.ndim == 2:
            flat = pa.array(np.ascontiguousarray(value).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, value.shape[1]))
        else:
            arrays.append(pa.array(value.tolist(), pa.string()) if value.dtype == object else pa.array(value))
        names.append(_column(field.name))
    table = pa.Table.from_arrays(arrays, names=names)
    metadata = {"protocol": protocol.name, "protocol_digest": protocol.digest}
    robot = load_robot(protocol.robot).digest
    if robot != FIRST_ROBOT:  # manifests from before robots had digests keep their bytes
        metadata["robot_digest"] = robot
    table = table.replace_schema_metadata(metadata)
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
    check_robot(table, protocol, f"manifest '{path}'", "freeze it again")
    columns = {}
    later = neutral(len(table))
    for field in fields(EpisodeManifest):
        if field.name in later and field.name not in table.column_names:
            columns[field.name] = later[field.name]
            continue
        column = table[_column(field.name)].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            columns[field.name] = column.flatten().to_numpy().reshape(-1, column.type.list_size)
        else:
            columns[field.name] = column.to_numpy(zero_copy_only=False)
    return EpisodeManifest(**columns), sha256


def check_robot(table: pa.Table, protocol: EvalProtocol, what: str, remedy: str) -> None:
    """Raises: ManifestError when targets were found feasible for another robot than the protocol has now."""
    made_for = (table.schema.metadata or {}).get(b"robot_digest", FIRST_ROBOT.encode()).decode()
    here = load_robot(protocol.robot).digest
    if made_for != here:
        raise ManifestError(
            f"{what} was drawn for a robot of digest {made_for[:16]}..., the robot of protocol "
            f"{protocol.name} has {here[:16]}...: its facts have changed, {remedy}"
        )


def _column(field: str) -> str:
    """Name in the file of a field of the manifest."""
    return _COLUMNS.get(field, field)
