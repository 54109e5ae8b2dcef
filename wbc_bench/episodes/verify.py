"""Verifying a frozen manifest: hash, counts, ranges, feasibility, and a sample of rows drawn again."""

from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import EpisodeManifest, neutral, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.randomization import resting_height
from wbc_bench.episodes.targets import BEYOND, solver_of
from wbc_bench.episodes.terrain import TERRAIN_SPAN
from wbc_bench.errors import ManifestError
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz

SAME = 1e-9  # [m, rad] another processor rounds differently


class Check(NamedTuple):
    """One line of a verification."""

    name: str
    ok: bool
    detail: str


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
        ("push_vel_z", noisy.push_vel_z, -push.vertical_speed, push.vertical_speed),
        ("push_ang_vel", noisy.push_ang_vel, -push.angular_speed, push.angular_speed),
        *((name, getattr(noisy, name), *getattr(spread, name)) for name in _LATER_RANGES),
        ("odometry_drift", noisy.odometry_drift, spread.odometry_drift, spread.odometry_drift),
        ("payload_offset", noisy.payload_offset, -spread.payload_offset, spread.payload_offset),
        ("joint_offset", noisy.joint_offset, -spread.joint_offset, spread.joint_offset),
        ("imu_tilt", np.linalg.norm(noisy.imu_tilt, axis=1), 0, spread.gravity_tilt + SAME),
        ("slope", np.linalg.norm(noisy.slope, axis=1), 0, spread.slope + SAME),
        ("terrain_offset", noisy.terrain_offset, -TERRAIN_SPAN, TERRAIN_SPAN),
        ("noise_scale", noisy.noise_scale, 1, 1),
        ("target quaternion", norm, 1 - 1e-12, 1 + 1e-12),
        ("nominal friction", quiet.friction, slide, slide),
        *((f"nominal {name}", getattr(quiet, name), 0, 0) for name in _ZERO_IF_NOMINAL),
        *((f"nominal {name}", getattr(quiet, name), value, value) for name, value in _later_nominal()),
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
    if not push.some or not np.isnan(quiet.push_time).all():
        checks.append(
            Check("no pushes", not pushes.any() and bool(np.isnan(quiet.push_time).all()), "none asked")
        )
    grounds = zip(manifest.leg_q[:200], manifest.slope, manifest.terrain_offset, strict=False)
    heights = [
        resting_height(protocol.robot, leg_q, slope, 0.0 if calm else spread.step_height, offset)
        for (leg_q, slope, offset), calm in zip(grounds, ~drawn, strict=False)
    ]
    worst = float(np.abs(heights - manifest.base_height[:200]).max())
    checks.append(Check("soles on the ground at reset", worst < SAME, f"off by at most {worst:.1e} m"))
    return checks


_LATER_RANGES = ("command_delay", "observation_delay", "odometry_delay", "payload", "motor_strength")


def _later_nominal() -> list[tuple[str, float]]:
    """The later columns and the one value that a nominal episode has in each."""
    return [(name, float(column.flat[0])) for name, column in neutral(1).items()]


_ZERO_IF_NOMINAL = ("base_mass", "base_vel", "leg_q", "leg_qd", "push_vel", "noise_scale")


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
