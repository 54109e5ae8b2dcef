"""Freezing a protocol into its manifest, and verifying a frozen one."""

import hashlib
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed

from wbc_bench.errors import ManifestError
from wbc_bench.manifest import EpisodeManifest, read_manifest, write_manifest
from wbc_bench.protocol import EvalProtocol, ReachTargets, WorkspaceTargets
from wbc_bench.randomization import draw, resting_height, undisturbed
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz
from wbc_bench.targets import (
    BEYOND,
    ReachPose,
    TargetDraw,
    best_reach_pose,
    draw_reach_target,
    draw_workspace_target,
    ladder,
    reach_poses,
    solver_of,
    stratum_of,
)

CHUNK = 16  # episodes a task: a second of work
SAME = 1e-9  # [m, rad] another processor rounds differently

Progress = Callable[[int, int], None]  # (done, total)


class Check(NamedTuple):
    """One line of a verification."""

    name: str
    ok: bool
    detail: str


# ---- freezing ----------------------------------------------------------------------------------------------


def freeze(
    protocol: EvalProtocol, path: Path, progress: Progress = lambda done, total: None, workers: int = 1
) -> str:
    """Draw every episode and write `path` and the hash beside it; equal bytes for any number of workers.

    Returns:
        SHA-256 of the manifest.

    Raises:
        ProtocolError: a stratum or a height that cannot be filled.
        ManifestError: the folder cannot be written.
    """
    manifest = build_manifest(protocol, progress, workers)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}_") as folder:
            fresh = Path(folder) / path.name
            write_manifest(manifest, protocol, fresh)
            sha256 = hashlib.sha256(fresh.read_bytes()).hexdigest()
            note = fresh.with_suffix(".sha256")
            note.write_text(f"{sha256}  {path.name}\n")
            for file in (fresh, note):
                with file.open("rb") as handle:
                    os.fsync(handle.fileno())
            fresh.replace(path)
            note.replace(path.with_suffix(".sha256"))
    except OSError as error:
        raise ManifestError(f"manifest '{path}' cannot be written: {error.strerror or error}") from error
    return sha256


def build_manifest(
    protocol: EvalProtocol, progress: Progress = lambda done, total: None, workers: int = 1
) -> EpisodeManifest:
    """The manifest of a protocol."""
    if isinstance(protocol.targets, ReachTargets):
        rows = _reach_rows(protocol, progress, workers)
    else:
        rows = _workspace_rows(protocol, progress, workers)
    columns = {}
    for field in fields(EpisodeManifest):
        values = [row[field.name] for row in rows]
        columns[field.name] = np.array(values, dtype=object if isinstance(values[0], str) else None)
    return EpisodeManifest(**columns)


def _row(protocol: EvalProtocol, replicate: int, episode: int, target: TargetDraw, **facts) -> dict:
    nominal = facts.get("condition") == "nominal"
    draws = (undisturbed if nominal else draw)(protocol, replicate, episode)
    return {
        "replicate": replicate,
        "episode": episode,
        "stratum": target.stratum,
        "condition": "",
        "orientation": "",
        "height": float(target.pos_w[2]),
        "target_pos_w": target.pos_w,
        "target_quat_w": target.quat_w,
        "witness_qpos": target.witness_qpos,
        **draws._asdict(),
        **facts,
    }


def _workspace_row(protocol: EvalProtocol, replicate: int, episode: int) -> dict:
    return _row(protocol, replicate, episode, draw_workspace_target(protocol, replicate, episode))


def _workspace_rows(protocol: EvalProtocol, progress: Progress, workers: int) -> list[dict]:
    size = protocol.episodes.per_replicate
    chunks = [
        [(replicate, episode) for episode in range(start, min(start + CHUNK, size))]
        for replicate in range(protocol.episodes.replicates)
        for start in range(0, size, CHUNK)
    ]

    def work(chunk: list[tuple[int, int]]) -> list[dict]:
        return [_workspace_row(protocol, *key) for key in chunk]

    rows = []
    for part in _parallel(workers, work, chunks):
        rows += part
        progress(len(rows), protocol.episodes.replicates * size)
    return rows


def _reach_rows(protocol: EvalProtocol, progress: Progress, workers: int) -> list[dict]:
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    heights, kinds = ladder(targets), targets.orientations
    rungs = [(orientation, float(height)) for orientation in kinds for height in heights]

    def search(rung: tuple[str, float]) -> ReachPose | None:
        return best_reach_pose(solver_of(protocol), rung[1], rung[0])

    best: list[ReachPose | None] = []
    for pose in _parallel(workers, search, rungs):
        best.append(pose)
        progress(len(best), 2 * len(rungs))
    poses = {
        kind: reach_poses(heights, best[i * len(heights) : (i + 1) * len(heights)])
        for i, kind in enumerate(kinds)
    }

    def work(rung: tuple[str, int]) -> list[TargetDraw]:
        kind, index = rung
        return [
            draw_reach_target(protocol, kind, index, k, poses[kind][index]) for k in range(targets.per_height)
        ]

    drawn: dict[tuple[str, int], list[TargetDraw]] = {}
    keys = [(kind, index) for kind in kinds for index in range(len(heights))]
    for key, draws in zip(keys, _parallel(workers, work, keys), strict=True):
        drawn[key] = draws
        progress(len(rungs) + len(drawn), 2 * len(rungs))
    rows = []
    for condition in targets.conditions:
        for kind, index in keys:
            for target in drawn[kind, index]:
                height = float(heights[index])
                rows.append(
                    _row(protocol, 0, len(rows), target, condition=condition, orientation=kind, height=height)
                )
    return rows


def _parallel(workers: int, work: Callable, items: Iterable) -> Iterator:
    """Results in the order of the items, as they come."""
    return Parallel(n_jobs=workers, return_as="generator")(delayed(work)(item) for item in items)  # pyright: ignore


# ---- verifying ---------------------------------------------------------------------------------------------


def verify(protocol: EvalProtocol, path: Path, sample: int = 30, seed: int = 0) -> list[Check]:
    """Everything a manifest promises; `sample` rows chosen by `seed` are drawn again and tried."""
    try:
        manifest, sha256 = read_manifest(protocol, path)
    except ManifestError as error:
        return [Check("hash and digest", False, str(error))]
    rows = np.sort(stream(seed, "verify").permutation(len(manifest))[:sample])
    return [
        Check("hash and digest", True, f"sha256 {sha256[:16]}..., protocol {protocol.digest[:16]}..."),
        _check_counts(protocol, manifest),
        *_check_ranges(protocol, manifest),
        _check_witnesses(protocol, manifest),
        _check_feasible(protocol, manifest.take(rows)),
        _check_redrawn(protocol, manifest, rows),
    ]


def expected_rows(protocol: EvalProtocol) -> int:
    """Episodes of a whole manifest."""
    targets = protocol.targets
    if isinstance(targets, ReachTargets):
        per_kind = len(ladder(targets)) * targets.per_height
        return per_kind * len(targets.orientations) * len(targets.conditions)
    return protocol.episodes.replicates * protocol.episodes.per_replicate


def _check_counts(protocol: EvalProtocol, manifest: EpisodeManifest) -> Check:
    targets, wrong = protocol.targets, []
    if len(manifest) != expected_rows(protocol):
        wrong.append(f"{len(manifest)} episodes, {expected_rows(protocol)} expected")
    for replicate in range(protocol.episodes.replicates):
        part = manifest.of_replicate(replicate)
        if not np.array_equal(part.episode, np.arange(len(part))):
            wrong.append(f"replicate {replicate}: episodes are not numbered 0..{len(part) - 1}")
        if isinstance(targets, WorkspaceTargets):
            asked = [stratum_of(targets.weights, episode) for episode in range(len(part))]
            if part.stratum.tolist() != asked:
                found, expected = dict(Counter(part.stratum)), dict(Counter(asked))
                wrong.append(f"replicate {replicate}: strata {found}, {expected} in turn expected")
    if isinstance(targets, ReachTargets):
        cells = Counter(zip(manifest.condition, manifest.orientation, manifest.height, strict=True))
        if set(cells.values()) != {targets.per_height}:
            wrong.append(f"episodes per height: {sorted(set(cells.values()))}, {targets.per_height} expected")
    counts = ", ".join(f"{name} {count}" for name, count in sorted(Counter(manifest.stratum).items()))
    return Check("counts", not wrong, "; ".join(wrong) or f"{len(manifest)} episodes: {counts}")


def _check_ranges(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[Check]:
    spread, push = protocol.randomization, protocol.push
    slide = load_robot(protocol.robot).facts.friction.slide
    drawn = manifest.condition != "nominal"
    noisy = manifest.take(np.flatnonzero(drawn))
    quiet = manifest.take(np.flatnonzero(~drawn))
    norm = np.linalg.norm(manifest.target_quat_w, axis=1)
    velocity = [spread.base_lin_vel] * 3 + [spread.base_ang_vel] * 3
    bounds = [
        ("friction", noisy.friction, *spread.friction),
        ("base_mass", noisy.base_mass, *spread.base_mass),
        ("base_vel", noisy.base_vel, -np.array(velocity), np.array(velocity)),
        ("leg_q", noisy.leg_q, -spread.leg_q, spread.leg_q),
        ("leg_qd", noisy.leg_qd, -spread.leg_qd, spread.leg_qd),
        ("kp_scale", noisy.kp_scale, *spread.gain),
        ("kd_scale", noisy.kd_scale, *spread.gain),
        ("push_time", noisy.push_time, push.interval[0], protocol.episodes.horizon - push.quiet_end),
        ("push_vel", noisy.push_vel, -push.speed, push.speed),
        ("noise_scale", noisy.noise_scale, 1, 1),
        ("target quaternion", norm, 1 - 1e-12, 1 + 1e-12),
        ("nominal friction", quiet.friction, slide, slide),
        *((f"nominal {name}", getattr(quiet, name), 0, 0) for name in _ZERO_IF_NOMINAL),
        ("nominal kp_scale", quiet.kp_scale, 1, 1),
        ("nominal kd_scale", quiet.kd_scale, 1, 1),
    ]
    checks = []
    for name, values, low, high in bounds:
        if values.size == 0 or np.isnan(values).all():
            continue
        inside = np.isnan(values) | ((values >= low) & (values <= high))
        detail = f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g}"
        checks.append(Check(f"range of {name}", bool(inside.all()), detail))
    pushes = np.isfinite(noisy.push_time)
    if push.speed == 0 or not np.isnan(quiet.push_time).all():
        checks.append(
            Check("no pushes", not pushes.any() and bool(np.isnan(quiet.push_time).all()), "none asked")
        )
    heights = [resting_height(protocol.robot, leg_q) for leg_q in manifest.leg_q[:200]]
    worst = float(np.abs(heights - manifest.base_height[:200]).max())
    checks.append(Check("soles on the ground at reset", worst < SAME, f"off by at most {worst:.1e} m"))
    return checks


_ZERO_IF_NOMINAL = ("base_mass", "base_vel", "leg_q", "leg_qd", "push_vel", "noise_scale")


def _check_witnesses(protocol: EvalProtocol, manifest: EpisodeManifest) -> Check:
    solver = solver_of(protocol)
    rows = np.flatnonzero(manifest.stratum != BEYOND)
    off = turned = 0.0
    for i in rows:
        pos, rot = solver.ee_pose(manifest.witness_qpos[i])
        off = max(off, float(np.abs(pos - manifest.target_pos_w[i]).max()))
        turned = max(turned, float(geodesic_angle(rot, matrix_from_wxyz(manifest.target_quat_w[i]))))
    ok = off < 1e-4 and turned < 1e-3
    return Check("witnesses reach their targets", ok, f"{len(rows)}: within {off:.1e} m, {turned:.1e} rad")


def _check_feasible(protocol: EvalProtocol, sample: EpisodeManifest) -> Check:
    """Constraints by MuJoCo alone, and whether the feet are in place exactly when the stratum says so."""
    solver, targets, wrong = solver_of(protocol), protocol.targets, []
    for i in np.flatnonzero(sample.stratum != BEYOND):
        qpos, label = sample.witness_qpos[i], f"episode {sample.replicate[i]}/{sample.episode[i]}"
        wrong += [f"{label}: {problem}" for problem in solver.violations(qpos)]
        stance = solver.stance_of(qpos)
        distance = float(np.hypot(stance.x, stance.y))
        if sample.stratum[i] == "step":
            assert isinstance(targets, WorkspaceTargets)
            low, high = targets.step_distance
            if not low - 1e-6 <= distance <= high + 1e-6:
                wrong.append(f"{label}: stance {distance:.3f} m away")
        elif distance > 1e-4 or abs(stance.yaw) > 1e-4:
            wrong.append(f"{label}: {sample.stratum[i]}, but its feet moved by {distance:.4f} m")
    return Check("feasibility of a sample", not wrong, "; ".join(wrong) or f"{len(sample)} episodes")


def _check_redrawn(protocol: EvalProtocol, manifest: EpisodeManifest, rows: np.ndarray) -> Check:
    """Draws the sampled rows again and compares every column."""
    if isinstance(protocol.targets, ReachTargets):
        fresh = _redraw_reach(protocol, manifest, rows)
    else:
        fresh = [_workspace_row(protocol, int(manifest.replicate[i]), int(manifest.episode[i])) for i in rows]
    wrong = []
    for row in fresh:
        here = (manifest.replicate == row["replicate"]) & (manifest.episode == row["episode"])
        if here.sum() != 1:
            wrong.append(f"episode {row['replicate']}/{row['episode']}: {here.sum()} rows")
            continue
        for field in fields(EpisodeManifest):
            frozen = getattr(manifest, field.name)[here][0]
            if isinstance(frozen, (str, np.integer)):
                same = row[field.name] == frozen
            else:
                same = np.allclose(row[field.name], frozen, rtol=0, atol=SAME, equal_nan=True)
            if not same:
                wrong.append(f"episode {row['replicate']}/{row['episode']}: {field.name}")
    detail = (
        f"{len(wrong)} values differ: {', '.join(wrong[:5])}" if wrong else f"{len(fresh)} episodes, equal"
    )
    return Check("redrawn sample", not wrong, detail)


def _redraw_reach(protocol: EvalProtocol, manifest: EpisodeManifest, rows: np.ndarray) -> list[dict]:
    """All episodes of two heights: the search for a height's pose is too slow to repeat for every row."""
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    heights = ladder(targets).tolist()
    feasible = rows[manifest.stratum[rows] != BEYOND]
    rungs = dict.fromkeys((str(manifest.orientation[i]), float(manifest.height[i])) for i in feasible)
    fresh = []
    for kind, height in list(rungs)[:2]:
        pose, index = best_reach_pose(solver_of(protocol), height, kind), heights.index(height)
        if pose is None:
            raise ManifestError(
                f"height {height:g} m, {kind}: the manifest has targets, and no pose is feasible"
            )
        for k in range(targets.per_height):
            target = draw_reach_target(protocol, kind, index, k, pose)
            for c, condition in enumerate(targets.conditions):
                rung = (c * len(targets.orientations) + targets.orientations.index(kind)) * len(
                    heights
                ) + index
                facts = {"condition": condition, "orientation": kind, "height": height}
                fresh.append(_row(protocol, 0, rung * targets.per_height + k, target, **facts))
    return fresh
