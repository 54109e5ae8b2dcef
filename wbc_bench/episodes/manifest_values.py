"""What the values of a manifest must be: ones that its protocol can draw, in the units of their columns."""

from collections.abc import Iterator
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.randomization import draw_columns, resting_height
from wbc_bench.episodes.rows import EpisodeManifest, neutral
from wbc_bench.episodes.targets import BEYOND
from wbc_bench.episodes.terrain import TERRAIN_SPAN
from wbc_bench.robot import load_robot

SAME = 1e-9  # [m, rad] another processor rounds differently
UNIT = 1e-12  # of the norm of a quaternion
SAMPLED = 50  # rows of a manifest that are drawn again whenever it is read; `verify` draws all
_LATER_RANGES = ("command_delay", "observation_delay", "odometry_delay", "payload", "motor_strength")
_MAY_BE_NAN = ("push_time", "feasible_qpos")  # no push, no feasible pose
_ZERO_IF_NOMINAL = ("base_mass", "base_vel", "leg_q", "leg_qd", "push_vel", "noise_scale")


class Bound(NamedTuple):
    """Values that all lie in a range."""

    name: str
    values: NDArray[np.float64]  # (N,) or (N, K)
    low: float | NDArray[np.float64]
    high: float | NDArray[np.float64]

    @property
    def inside(self) -> bool:
        """Whether all that are defined lie in the range."""
        known = np.isnan(self.values) | ((self.values >= self.low) & (self.values <= self.high))
        return bool(known.all())

    @property
    def extent(self) -> str:
        """Smallest and largest value."""
        return f"{np.nanmin(self.values):.4g} to {np.nanmax(self.values):.4g}"


def bounds(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[Bound]:
    """The ranges of all draws, without those of which no value is defined."""
    spread, push = protocol.randomization, protocol.push
    slide = load_robot(protocol.robot).facts.friction.slide
    drawn = manifest.condition != "nominal"
    noisy = manifest.take(np.flatnonzero(drawn))
    quiet = manifest.take(np.flatnonzero(~drawn))
    norm = np.linalg.norm(manifest.target_quat_w, axis=1)
    later = neutral(1).items()
    velocity = np.array([spread.base_lin_vel] * 3 + [spread.base_ang_vel] * 3)
    found = [
        Bound("friction", noisy.friction, *spread.friction),
        Bound("base_mass", noisy.base_mass, *spread.base_mass),
        Bound("base_vel", noisy.base_vel, -velocity, velocity),
        Bound("leg_q", noisy.leg_q, -spread.leg_q, spread.leg_q),
        Bound("leg_qd", noisy.leg_qd, -spread.leg_qd, spread.leg_qd),
        Bound("kp_scale", noisy.kp_scale, *spread.gain),
        Bound("kd_scale", noisy.kd_scale, *spread.gain),
        Bound("push_time", noisy.push_time, push.interval[0], protocol.episodes.horizon - push.quiet_end),
        Bound("push_vel", noisy.push_vel, -push.speed, push.speed),
        Bound("push_vel_z", noisy.push_vel_z, -push.vertical_speed, push.vertical_speed),
        Bound("push_ang_vel", noisy.push_ang_vel, -push.angular_speed, push.angular_speed),
        *(Bound(name, getattr(noisy, name), *getattr(spread, name)) for name in _LATER_RANGES),
        Bound("odometry_drift", noisy.odometry_drift, spread.odometry_drift, spread.odometry_drift),
        Bound("payload_offset", noisy.payload_offset, -spread.payload_offset, spread.payload_offset),
        Bound("joint_offset", noisy.joint_offset, -spread.joint_offset, spread.joint_offset),
        Bound("imu_tilt", np.linalg.norm(noisy.imu_tilt, axis=1), 0, spread.gravity_tilt + SAME),
        Bound("slope", np.linalg.norm(noisy.slope, axis=1), 0, spread.slope + SAME),
        Bound("terrain_offset", noisy.terrain_offset, -TERRAIN_SPAN, TERRAIN_SPAN),
        Bound("noise_scale", noisy.noise_scale, 1, 1),
        Bound("target quaternion", norm, 1 - UNIT, 1 + UNIT),
        Bound("nominal friction", quiet.friction, slide, slide),
        *(Bound(f"nominal {name}", getattr(quiet, name), 0, 0) for name in _ZERO_IF_NOMINAL),
        Bound("nominal kp_scale", quiet.kp_scale, 1, 1),
        Bound("nominal kd_scale", quiet.kd_scale, 1, 1),
        *(Bound(f"nominal {name}", getattr(quiet, name), *[column.flat[0]] * 2) for name, column in later),
    ]
    return [bound for bound in found if bound.values.size and not np.isnan(bound.values).all()]


def height_error(protocol: EvalProtocol, manifest: EpisodeManifest) -> float:
    """Largest distance [m] of a base's height at reset from the one at which the soles touch the ground."""
    bumps = np.where(manifest.condition == "nominal", 0.0, protocol.randomization.step_height)
    grounds = zip(manifest.leg_q, manifest.slope, bumps, manifest.terrain_offset, strict=True)
    heights = [resting_height(protocol.robot, *ground) for ground in grounds]
    return float(np.abs(heights - manifest.base_height).max())


def mistakes(protocol: EvalProtocol, manifest: EpisodeManifest, sampled: int = SAMPLED) -> Iterator[str]:
    """What is wrong with the values of a manifest that has the protocol's columns and number of rows.

    `sampled` rows, evenly spread, are drawn again: a column in a wrong unit may lie in its range.
    """
    size = protocol.episodes.per_replicate
    for name, expected in (
        ("replicate", np.repeat(np.arange(protocol.episodes.replicates), size)),
        ("episode", np.tile(np.arange(size), protocol.episodes.replicates)),
    ):
        if not np.array_equal(getattr(manifest, name), expected):
            yield f"{name} does not count the rows, valid: replicate by replicate, episodes from 0"
            return  # the other checks name episodes
    for field in fields(manifest):
        value = getattr(manifest, field.name)
        if value.dtype.kind == "f" and field.name not in _MAY_BE_NAN and not np.isfinite(value).all():
            yield f"{field.name} holds a number that is not finite"
            return
    yield from kind_of(protocol).target_mistakes(protocol, manifest)
    yield from kind_of(protocol).count_mistakes(protocol, manifest)
    for bound in bounds(protocol, manifest):
        if not bound.inside:
            low, high = (f"{np.ravel(edge)[0]:g}" for edge in (bound.low, bound.high))
            yield f"{bound.name} is {bound.extent}, valid: {low} to {high}"
    if (manifest.noise_key < 0).any():
        yield f"noise_key is {manifest.noise_key.min()}, valid: 0 or more"
    yield from _push_mistakes(protocol, manifest)
    yield from _pose_mistakes(manifest)
    spread = np.linspace(0, len(manifest) - 1, min(sampled, len(manifest))).astype(np.int64)
    yield from _draw_mistakes(protocol, manifest.take(spread))


def _push_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> Iterator[str]:
    time = manifest.push_time
    none = np.isnan(time)
    if not none.all() and not protocol.push.some:
        yield "push_time holds pushes, and the protocol has none"
    if not none[manifest.condition == "nominal"].all():
        yield "push_time holds pushes of nominal episodes, valid: none"
    if (manifest.push_vel[np.repeat(none, 2, axis=1)] != 0).any():
        yield "push_vel holds velocities without a time, valid: 0"
    if (np.diff(time, axis=1) <= 0).any() or (none[:, :-1] & ~none[:, 1:]).any():
        yield "push_time does not rise within an episode"


def _pose_mistakes(manifest: EpisodeManifest) -> Iterator[str]:
    qpos = manifest.feasible_qpos
    beyond = manifest.stratum == BEYOND
    if not np.isnan(qpos[beyond]).all():
        yield f"feasible_qpos of targets '{BEYOND}' has numbers, valid: NaN"
    if not np.isfinite(qpos[~beyond]).all():
        yield "feasible_qpos holds a number that is not finite"
    elif (np.abs(np.linalg.norm(qpos[~beyond, 3:7], axis=1) - 1) > UNIT).any():
        yield "feasible_qpos has a quaternion whose norm is not 1"


def _draw_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> Iterator[str]:
    """Columns that are not what the protocol's seed draws."""
    for name, drawn in draw_columns(protocol, manifest).items():
        off = ~np.isclose(getattr(manifest, name), drawn, rtol=0, atol=SAME, equal_nan=True)
        if off.any():
            i = int(off.reshape(len(manifest), -1).any(axis=1).argmax())
            place = f"{manifest.replicate[i]}/{manifest.episode[i]}"
            yield f"{name} of episode {place} is not what the protocol's seed draws"
