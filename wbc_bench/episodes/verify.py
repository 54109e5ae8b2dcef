"""Verifying a frozen manifest: hash, counts, ranges, feasibility, and a sample of rows drawn again."""

from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import read_manifest
from wbc_bench.episodes.manifest_values import SAME, bounds, height_error, mistakes
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.episodes.targets import BEYOND, solver_of
from wbc_bench.errors import ManifestError
from wbc_bench.randomness import stream
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz


class Check(NamedTuple):
    """One line of a verification."""

    name: str
    ok: bool
    detail: str


def verify(protocol: EvalProtocol, path: Path, sample: int = 30, seed: int = 0) -> list[Check]:
    """Everything a manifest promises; `sample` rows chosen by `seed` are drawn again and tried."""
    try:
        manifest, sha256 = read_manifest(protocol, path, check_values=False)
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


def _check_counts(protocol: EvalProtocol, manifest: EpisodeManifest) -> Check:
    kind, wrong = kind_of(protocol), []
    if len(manifest) != kind.num_rows(protocol):
        wrong.append(f"{len(manifest)} episodes, {kind.num_rows(protocol)} expected")
    for replicate in range(protocol.episodes.replicates):
        part = manifest.of_replicate(replicate)
        if not np.array_equal(part.episode, np.arange(len(part))):
            wrong.append(f"replicate {replicate}: episodes are not numbered 0..{len(part) - 1}")
    wrong += kind.count_mistakes(protocol, manifest)
    counts = ", ".join(f"{name} {count}" for name, count in sorted(Counter(manifest.stratum).items()))
    return Check("counts", not wrong, "; ".join(wrong) or f"{len(manifest)} episodes: {counts}")


def _check_ranges(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[Check]:
    checks = [
        Check(f"range of {bound.name}", bound.inside, bound.extent) for bound in bounds(protocol, manifest)
    ]
    if not protocol.push.some:
        checks.append(Check("no pushes", bool(np.isnan(manifest.push_time).all()), "none asked"))
    worst = height_error(protocol, manifest)
    checks.append(Check("soles on the ground at reset", worst < SAME, f"off by at most {worst:.1e} m"))
    wrong = list(mistakes(protocol, manifest))
    checks.append(Check("values", not wrong, "; ".join(wrong) or "labels, targets, draws and pushes"))
    return checks


def _check_witnesses(protocol: EvalProtocol, manifest: EpisodeManifest) -> Check:
    solver = solver_of(protocol)
    rows = np.flatnonzero(manifest.stratum != BEYOND)
    off = turned = 0.0
    for i in rows:
        pos, rot = solver.ee_pose(manifest.feasible_qpos[i])
        off = max(off, float(np.abs(pos - manifest.target_pos_w[i]).max()))
        turned = max(turned, float(geodesic_angle(rot, matrix_from_wxyz(manifest.target_quat_w[i]))))
    ok = off < 1e-4 and turned < 1e-3
    return Check("witnesses reach their targets", ok, f"{len(rows)}: within {off:.1e} m, {turned:.1e} rad")


def _check_feasible(protocol: EvalProtocol, sample: EpisodeManifest) -> Check:
    """Constraints by MuJoCo alone, and whether the feet are in place exactly when the stratum says so."""
    solver, wrong = solver_of(protocol), []
    for i in np.flatnonzero(sample.stratum != BEYOND):
        qpos, label = sample.feasible_qpos[i], f"episode {sample.replicate[i]}/{sample.episode[i]}"
        wrong += [f"{label}: {problem}" for problem in solver.violations(qpos)]
        frame = solver.ground_frame_of(qpos)
        distance = float(np.hypot(frame.x, frame.y))
        if sample.stratum[i] == "step":
            low, high = kind_of(protocol).step_distance(protocol)
            if not low - 1e-6 <= distance <= high + 1e-6:
                wrong.append(f"{label}: stance {distance:.3f} m away")
        elif distance > 1e-4 or abs(frame.yaw) > 1e-4:
            wrong.append(f"{label}: {sample.stratum[i]}, but its feet moved by {distance:.4f} m")
    return Check("feasibility of a sample", not wrong, "; ".join(wrong) or f"{len(sample)} episodes")


def _check_redrawn(protocol: EvalProtocol, manifest: EpisodeManifest, rows: np.ndarray) -> Check:
    """Draws the sampled rows again and compares every column."""
    fresh = kind_of(protocol).redraw(protocol, manifest, rows)
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
