"""The targets of training: feasible ones from the evaluation's own generator, generated once and stored.

Finding a target takes about 40 ms (100 ms in the stratum `step`), while a training run needs one every few
hundred microseconds. A set is therefore generated once, from random streams that no evaluation shares, and
episodes pick from it.
"""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from shlex import quote
from typing import NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wbc_baselines.learned.packaged import TARGET_SETS
from wbc_bench.episodes.manifest import check_robot
from wbc_bench.episodes.protocol import EvalProtocol, WorkspaceTargets
from wbc_bench.episodes.workspace_targets import draw_workspace_target
from wbc_bench.errors import ManifestError, ProtocolError
from wbc_bench.files import write_atomic
from wbc_bench.outcomes import STRATA
from wbc_bench.parallel import in_parallel
from wbc_bench.readers import read_parquet
from wbc_bench.robot import load_robot
from wbc_bench.schema import meaning

SEED_OFFSET = 2**62  # added to the protocol's seed, so that no evaluation uses the same random stream
CHUNK = 30  # targets per task, about a second of work

Progress = Callable[[int, int], None]  # (done, total)


class TargetSet(NamedTuple):
    """M feasible targets."""

    stratum: NDArray[np.int8]  # (M,) index into STRATA
    pos_w: NDArray[np.float32]  # (M, 3) [m]
    quat_w: NDArray[np.float32]  # (M, 4) wxyz
    witness_qpos: NDArray[
        np.float32
    ]  # (M, 21) feasible posture that reaches the target: base [m], wxyz, joints [rad]

    def __len__(self) -> int:
        return len(self.stratum)


def digest(protocol: EvalProtocol) -> str:
    """Return the SHA-256 of the parts of a protocol that targets depend on: ranges, robot, limits, seed."""
    sections = (protocol.targets, protocol.robot, protocol.termination)
    parts = [*map(meaning, sections), protocol.episodes.seed]
    # in the order of the fields, as the digests of the sets that ship were made
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


def draw_target_set(
    protocol: EvalProtocol, count: int, workers: int = 1, progress: Progress = lambda done, total: None
) -> TargetSet:
    """Generate feasible targets, alternating between the strata.

    Args:
        protocol: Protocol whose targets are generated.
        count: Number of targets.
        workers: Number of processes; the result does not depend on it.
        progress: Is called with completed and total targets.

    Returns:
        A set of `count` targets.

    Raises:
        ProtocolError: The protocol has no workspace targets, or a stratum cannot be filled.
    """
    _check_targets(protocol)
    seed = protocol.episodes.seed + SEED_OFFSET
    shifted = msgspec.structs.replace(
        protocol, episodes=msgspec.structs.replace(protocol.episodes, seed=seed)
    )

    def work(start: int) -> list[tuple]:
        draws = [draw_workspace_target(shifted, 0, k) for k in range(start, min(start + CHUNK, count))]
        return [(STRATA.index(d.stratum), d.pos_w, d.quat_w, d.feasible_qpos) for d in draws]

    rows: list[tuple] = []
    for part in in_parallel(workers, work, range(0, count, CHUNK)):
        rows.extend(part)
        progress(len(rows), count)
    stratum, *poses = zip(*rows, strict=True)
    return TargetSet(np.array(stratum, np.int8), *(np.array(pose, np.float32) for pose in poses))


def write_target_set(target_set: TargetSet, protocol: EvalProtocol, path: Path) -> None:
    """Write a target set with the digest of its protocol, atomically.

    Args:
        target_set: Targets to write.
        protocol: Protocol they were generated for.
        path: Parquet file, in a folder that is there.

    Raises:
        StoreError: It cannot be written.
    """
    columns = [pa.array(target_set.stratum)]
    for values in target_set[1:]:
        columns.append(pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1]))
    table = pa.Table.from_arrays(columns, names=list(TargetSet._fields))
    robot = load_robot(protocol.robot).digest
    table = table.replace_schema_metadata(
        {"protocol": protocol.name, "digest": digest(protocol), "robot_digest": robot}
    )
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer, compression="zstd", use_dictionary=False)
    write_atomic(path, buffer.getvalue().to_pybytes())


def read_target_set(
    protocol: EvalProtocol, path: Path | None = None, requested: str | None = None
) -> TargetSet:
    """Read the target set of a protocol.

    Args:
        protocol: Protocol of the training.
        path: Parquet file; None for the set that ships with the package.
        requested: What the user gave to select the protocol, which error messages repeat, e.g. the path of a
            file; the protocol's name when not given.

    Returns:
        The targets.

    Raises:
        ProtocolError: The protocol has no workspace targets.
        ManifestError: The file is missing, unreadable, or was generated for other targets, another robot or
            other limits.
    """
    _check_targets(protocol)
    command = f"wbc-train targets --protocol {quote(requested or protocol.name)}"
    if path is not None:
        command += f" --path {quote(str(path))}"
    path = path or _shipped(protocol)
    if not path.exists():
        raise ManifestError(f"target set '{path}' does not exist: make it with `{command}`")
    table = read_parquet(path, "target set", ManifestError, COLUMNS)
    made_for = (table.schema.metadata or {}).get(b"digest", b"").decode(errors="replace")
    if made_for != digest(protocol):
        raise ManifestError(
            f"target set '{path}' was drawn for digest {made_for[:16] or 'none'}..., protocol "
            f"{protocol.name} has {digest(protocol)[:16]}...: draw it again with `{command}`"
        )
    check_robot(table, protocol, f"target set '{path}'", f"draw it again with `{command}`")

    def matrix(name: str) -> NDArray[np.float32]:
        column = table[name].combine_chunks()
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(table), _WIDTHS[name])

    found = TargetSet(table["stratum"].to_numpy(), *map(matrix, _WIDTHS))
    for problem in _mistakes(found):
        raise ManifestError(f"target set '{path}': {problem}: draw it again with `{command}`")
    return found


def _shipped(protocol: EvalProtocol) -> Path:
    """The set of this package for a protocol: protocols of the same targets, robot and limits share one."""
    for path in sorted(TARGET_SETS.glob("*.parquet")):
        if (pq.read_schema(path).metadata or {}).get(b"digest", b"").decode() == digest(protocol):
            return path
    return TARGET_SETS / f"{protocol.name}.parquet"


_WIDTHS = {"pos_w": 3, "quat_w": 4, "witness_qpos": 21}
COLUMNS = {"stratum": "int8"}
COLUMNS |= {name: f"fixed_size_list<element: float>[{width}]" for name, width in _WIDTHS.items()}


def _mistakes(found: TargetSet) -> Iterator[str]:
    """What is wrong with the values of a target set."""
    if len(found) == 0 or not ((found.stratum >= 0) & (found.stratum < len(STRATA))).all():
        yield f"strata {np.unique(found.stratum).tolist()}, valid: 0 to {len(STRATA) - 1}"
    for name in _WIDTHS:
        if not np.isfinite(getattr(found, name)).all():
            yield f"{name} holds a number that is not finite"
    for quat in (found.quat_w, found.witness_qpos[:, 3:7]):
        if not (np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-5).all():  # of float32
            yield "the norm of a quaternion is not 1"


def _check_targets(protocol: EvalProtocol) -> None:
    if not isinstance(protocol.targets, WorkspaceTargets):
        raise ProtocolError(f"protocol {protocol.name}: targets of type reach, valid for training: workspace")
