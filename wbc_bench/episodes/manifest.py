"""The frozen manifest of a protocol: its file, the hash beside it, and what reading one checks."""

import hashlib
from dataclasses import fields
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from wbc_bench.episodes.manifest_values import mistakes
from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol
from wbc_bench.episodes.rows import EpisodeManifest, neutral
from wbc_bench.errors import ManifestError
from wbc_bench.files import PROTOCOLS, real_path
from wbc_bench.readers import check_columns, decode_parquet, read_bytes, read_digest
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, load_robot

# Column of the file for a field of another name: frozen manifests keep their bytes.
_COLUMNS = {"feasible_qpos": "witness_qpos"}
# Robot of the files that name none: they are older than robots' digests, and all of the default one.
FIRST_ROBOT = "48400a5d91d46b753bce351b4f6a990fa7bf5a82477d97946413a111328421c0"
_WIDTHS = {  # fields with more than one number per episode
    **{"target_pos_w": 3, "target_quat_w": 4, "feasible_qpos": 7 + NUM_JOINTS, "base_vel": 6},
    **{"leg_q": NUM_LEG_JOINTS, "leg_qd": NUM_LEG_JOINTS, "kp_scale": NUM_JOINTS, "kd_scale": NUM_JOINTS},
    **{"push_time": MAX_PUSHES, "push_vel": 2 * MAX_PUSHES, "push_vel_z": MAX_PUSHES},
    **{"push_ang_vel": 3 * MAX_PUSHES, "joint_offset": NUM_JOINTS, "payload_offset": 3},
    **{"imu_tilt": 2, "slope": 2, "terrain_offset": 2},
}
_INTEGERS = ("replicate", "episode", "noise_key")
_LABELS = ("stratum", "condition", "orientation")


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
    sink = pa.BufferOutputStream()  # given a path, arrow takes a tilde for a home folder, a colon for a URI
    pq.write_table(table, sink, compression="zstd", use_dictionary=False)
    path.write_bytes(sink.getvalue())


def read_manifest(
    protocol: EvalProtocol, path: Path, check_values: bool = True
) -> tuple[EpisodeManifest, str]:
    """The manifest of a protocol and the SHA-256 of its file.

    Args:
        protocol: The protocol.
        path: The manifest; its hash stands beside it.
        check_values: Whether every value must be one that the protocol can draw; `verify` tells more of those
            that are not.

    Raises:
        ManifestError: missing, unreadable, made for another protocol, altered since it was frozen, or its
            columns, types, counts or values are not those of the protocol.
    """
    if not path.exists():
        raise ManifestError(
            f"manifest '{path}' does not exist: make it with `wbc-bench protocol freeze {_given(path)}`"
        )
    data = read_bytes(path, "manifest", ManifestError)
    sha256 = hashlib.sha256(data).hexdigest()
    hash_file = path.with_suffix(".sha256")
    recorded = read_digest(hash_file, "hash", ManifestError) if hash_file.exists() else "none recorded"
    if recorded != sha256:
        raise ManifestError(
            f"manifest '{path}' does not match its hash: it has {sha256[:16]}..., "
            f"{hash_file.name} says {recorded[:16]}..."
        )
    count = protocol.episodes.replicates * protocol.episodes.per_replicate
    table = decode_parquet(data, path, "manifest", ManifestError)
    made_for = digest_made_for(table)
    if made_for != protocol.digest:
        raise ManifestError(
            f"manifest '{path}' was made for protocol digest {made_for[:16] or 'none'}..., "
            f"the protocol {protocol.name} has {protocol.digest[:16]}...: make it again with "
            f"`wbc-bench protocol freeze {_given(path)}`"
        )
    remedy = f"make it again with `wbc-bench protocol freeze {_given(path)}`"
    check_robot(table, protocol, f"manifest '{path}'", remedy)
    found: dict[str, Any] = {**neutral(len(table))}
    present = [f.name for f in fields(EpisodeManifest) if f.name not in found or f.name in table.column_names]
    columns = {_column(name): _type(name) for name in present}
    check_columns(table, path, "manifest", ManifestError, columns)
    if table.shape != (count, len(columns)):
        raise ManifestError(
            f"manifest '{path}' has (rows, columns) {table.shape}, valid: {(count, len(columns))}"
        )
    columns_read: dict[str, Any] = dict(neutral(len(table)))
    columns_read |= {name: _array(table, name) for name in present}
    manifest = EpisodeManifest(**columns_read)
    if check_values:
        for mistake in mistakes(protocol, manifest):
            raise ManifestError(
                f"manifest '{path}': {mistake}; `wbc-bench protocol verify {_given(path)}` tells all"
            )
    return manifest, sha256


def digest_made_for(table: pa.Table) -> str:
    """Digest of the protocol that a manifest says it was made for; empty where it says none."""
    return (table.schema.metadata or {}).get(b"protocol_digest", b"").decode(errors="replace")


def check_robot(table: pa.Table, protocol: EvalProtocol, what: str, remedy: str) -> None:
    """Raises: ManifestError when targets were found feasible for another robot than the protocol has now."""
    made_for = (table.schema.metadata or {}).get(b"robot_digest", FIRST_ROBOT.encode())
    made_for = made_for.decode(errors="replace")
    here = load_robot(protocol.robot).digest
    if made_for != here:
        raise ManifestError(
            f"{what} was drawn for a robot of digest {made_for[:16]}..., the robot of protocol "
            f"{protocol.name} has {here[:16]}...: its facts have changed, {remedy}"
        )


def _type(field: str) -> str:
    """Name in arrow of the type of a column."""
    if field in _WIDTHS:
        return f"fixed_size_list<element: double>[{_WIDTHS[field]}]"
    return "string" if field in _LABELS else "int64" if field in _INTEGERS else "double"


def _array(table: pa.Table, field: str) -> np.ndarray:
    column = table[_column(field)].combine_chunks()
    if field in _WIDTHS:
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(table), _WIDTHS[field])
    return column.to_numpy(zero_copy_only=False)


def _given(path: Path) -> str:
    """How a command is given the protocol of a manifest: one of a user's own is found by its file alone."""
    released = real_path(path).parent == real_path(PROTOCOLS)
    return path.stem if released else quote(str(path.with_suffix(".toml")))


def _column(field: str) -> str:
    """Name in the file of a field of the manifest."""
    return _COLUMNS.get(field, field)
