"""Targets all over the whole-body workspace: a box of poses, in equal parts or by weight of stratum."""

from collections import Counter

import numpy as np

from wbc_bench.episodes.ground_frame import GroundFrame, from_ground_frame
from wbc_bench.episodes.protocol import EvalProtocol, WorkspaceTargets
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.episodes.targets import (
    MAX_ATTEMPTS,
    Progress,
    TargetDraw,
    classify,
    manifest_row,
    solver_of,
)
from wbc_bench.errors import ProtocolError
from wbc_bench.outcomes import STRATA
from wbc_bench.parallel import in_parallel
from wbc_bench.randomness import stream
from wbc_bench.rotations import matrix_from_rpy, matrix_from_wxyz, wxyz_from_matrix

ROUNDING = 1e-9  # [m] of a pose that went through a displaced frame
CHUNK = 16  # episodes a task: a second of work


def stratum_of(weights: dict, episode: int) -> str:
    """The stratum an episode is to have: the weighted strata in turn, so that every beginning is balanced."""
    cycle = [name for name in STRATA for _ in range(weights.get(name, 0))]
    return cycle[episode % len(cycle)]


def draw_workspace_target(protocol: EvalProtocol, replicate: int, episode: int) -> TargetDraw:
    """The target of an episode: uniform in the box, given that it falls into the episode's stratum.

    The box is about the stance; for `step` a displaced stance is drawn with every candidate.

    Raises:
        ProtocolError: no candidate in MAX_ATTEMPTS falls into the stratum.
    """
    targets, solver = protocol.targets, solver_of(protocol)
    assert isinstance(targets, WorkspaceTargets)
    rng = stream(protocol.episodes.seed, "target", replicate, episode)
    stratum = stratum_of(targets.weights, episode)
    low, high = np.transpose([targets.x, targets.y, targets.height, targets.roll, targets.pitch, targets.yaw])
    for attempt in range(1, MAX_ATTEMPTS + 1):
        candidate = rng.uniform(low, high)
        pos, rot = candidate[:3], matrix_from_rpy(candidate[3:])
        frame, witness = GroundFrame(), None
        if stratum == "arm":
            witness = solver.solve_arm(pos, rot)
        elif stratum == "posture":
            if solver.solve_arm(pos, rot) is None:
                witness = solver.solve_posture(pos, rot)
        else:
            frame = _draw_ground_frame(targets, rng)
            found = classify(solver, pos, rot)
            if found is not None and classify(solver, *from_ground_frame(frame, pos, rot)) is None:
                witness = found[1]
        if witness is not None:
            pos_w, rot_w = from_ground_frame(frame, pos, rot)
            base_w, base_rot_w = from_ground_frame(
                frame, witness.qpos[:3], matrix_from_wxyz(witness.qpos[3:7])
            )
            qpos = np.concatenate([base_w, wxyz_from_matrix(base_rot_w), witness.qpos[7:]])
            return TargetDraw(stratum, pos_w, wxyz_from_matrix(rot_w), qpos, attempt)
    raise ProtocolError(
        f"protocol {protocol.name}: none of {MAX_ATTEMPTS} poses in the box is a '{stratum}' target "
        f"(replicate {replicate}, episode {episode}) - at `$.targets`"
    )


def _draw_ground_frame(targets: WorkspaceTargets, rng: np.random.Generator) -> GroundFrame:
    distance, bearing = rng.uniform(*targets.step_distance), rng.uniform(-np.pi, np.pi)
    return GroundFrame(distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(*targets.step_yaw))


def _row(protocol: EvalProtocol, replicate: int, episode: int) -> dict:
    return manifest_row(protocol, replicate, episode, draw_workspace_target(protocol, replicate, episode))


def rows(protocol: EvalProtocol, progress: Progress, workers: int) -> list[dict]:
    """Every row of the manifest, by replicate and episode."""
    size = protocol.episodes.per_replicate
    chunks = [
        [(replicate, episode) for episode in range(start, min(start + CHUNK, size))]
        for replicate in range(protocol.episodes.replicates)
        for start in range(0, size, CHUNK)
    ]

    def work(chunk: list[tuple[int, int]]) -> list[dict]:
        return [_row(protocol, *key) for key in chunk]

    drawn = []
    for part in in_parallel(workers, work, chunks):
        drawn += part
        progress(len(drawn), protocol.episodes.replicates * size)
    return drawn


def num_rows(protocol: EvalProtocol) -> int:
    """Episodes of a whole manifest."""
    return protocol.episodes.replicates * protocol.episodes.per_replicate


def count_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
    """What is wrong with the strata of a manifest."""
    targets, wrong = protocol.targets, []
    assert isinstance(targets, WorkspaceTargets)
    for replicate in range(protocol.episodes.replicates):
        part = manifest.of_replicate(replicate)
        asked = [stratum_of(targets.weights, episode) for episode in range(len(part))]
        if part.stratum.tolist() != asked:
            found, expected = dict(Counter(part.stratum)), dict(Counter(asked))
            wrong.append(f"replicate {replicate}: strata {found}, {expected} in turn expected")
    return wrong


def target_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
    """Targets outside the box, which is displaced with the stance for `step`, and labels of another kind."""
    targets, wrong = protocol.targets, []
    assert isinstance(targets, WorkspaceTargets)
    if any(manifest.condition) or any(manifest.orientation):
        wrong.append("conditions and orientations belong to reach targets, valid: none")
    if not np.array_equal(manifest.height, manifest.target_pos_w[:, 2]):
        wrong.append("height is not that of the target")
    x, y, z = manifest.target_pos_w.T
    corner = np.hypot(*np.abs([targets.x, targets.y]).max(axis=1))
    within = (targets.x[0] <= x) & (x <= targets.x[1]) & (targets.y[0] <= y) & (y <= targets.y[1])
    near = np.hypot(x, y) <= corner + targets.step_distance[1] + ROUNDING
    within = np.where(manifest.stratum == "step", near, within)
    within &= (targets.height[0] - ROUNDING <= z) & (z <= targets.height[1] + ROUNDING)
    if not within.all():
        i = int(within.argmin())
        wrong.append(
            f"target of episode {manifest.replicate[i]}/{manifest.episode[i]} at "
            f"{manifest.target_pos_w[i].tolist()} m "
            "is outside the protocol's box"
        )
    return wrong


def step_distance(protocol: EvalProtocol) -> tuple[float, float]:
    """Shortest and longest displacement [m] of the stance of a `step` target."""
    assert isinstance(protocol.targets, WorkspaceTargets)
    return protocol.targets.step_distance


def redraw(protocol: EvalProtocol, manifest: EpisodeManifest, sample: np.ndarray) -> list[dict]:
    """The sampled rows, drawn again."""
    return [_row(protocol, int(manifest.replicate[i]), int(manifest.episode[i])) for i in sample]
