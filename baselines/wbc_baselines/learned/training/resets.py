"""Random samples of training episodes: the quantities and ranges of an evaluation, many episodes at once."""

from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.training.backends.base import ResetState
from wbc_baselines.learned.training.target_set import TargetSet
from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol, Push, WorkspaceTargets
from wbc_bench.episodes.randomization import nominal, resting_height
from wbc_bench.evaluation.delays import physics_steps
from wbc_bench.outcomes import STRATA
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, load_robot

Array = NDArray[np.float64]
DECAY = (0.5, 1.4)  # [1/s] v_ref in training. Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
# Of arm, posture and step at the start of a curriculum; choice. It ends at the protocol's weights.
INITIAL_STRATUM_PROBABILITIES = np.array([0.6, 0.3, 0.1])


class EpisodeSamples(NamedTuple):
    """Everything that is random about K episodes, except for the observation noise."""

    reset: ResetState
    target: NDArray[np.int64]  # (K,) row of the target set
    decay: Tensor  # (K,) [1/s]
    push_step: Tensor  # (K, P) control step before which the push comes, -1 for none
    push_vel: Tensor  # (K, P, 6) linear in the world [m/s], angular in the base [rad/s]
    delays: Tensor  # (K, 3) physics steps: of commands, observations and odometry
    imu_tilt: Tensor  # (K, 2) [rad] rotation vector
    noise_scale: Tensor  # (K,) 0 for an episode without noise, else 1


def stratum_probabilities(protocol: EvalProtocol, curriculum: float) -> Array:
    """Compute the probabilities (3,) of the strata.

    Args:
        protocol: Protocol whose weights apply at the end of the curriculum.
        curriculum: Completed fraction in [0, 1] of the curriculum.

    Returns:
        Probabilities of the strata in the order of STRATA.
    """
    assert isinstance(protocol.targets, WorkspaceTargets)
    weights = protocol.targets.weights
    last = np.array([float(weights.get(name, 0)) for name in STRATA])
    return INITIAL_STRATUM_PROBABILITIES * (1 - curriculum) + last / last.sum() * curriculum


def scale_disturbances(protocol: EvalProtocol, scale: float) -> EvalProtocol:
    """Scale the noise, the pushes and the randomization of a protocol.

    Args:
        protocol: Protocol to scale.
        scale: Scale in [0, 1]: no disturbance and the nominal robot at 0, the protocol itself at 1.

    Returns:
        The scaled protocol.
    """
    if scale == 1.0:
        return protocol

    def scaled(struct: Any, **nominal: float) -> Any:
        """Every field between its nominal value, 0 unless named, and the protocol's."""
        found = {}
        for name in struct.__struct_fields__:
            value, still = np.array(getattr(struct, name)), nominal.get(name, 0.0)
            found[name] = (still + scale * (value - still)).tolist()
        return msgspec.convert(found, type(struct))

    slide = load_robot(protocol.robot).facts.friction.slide
    names = ("speed", "vertical_speed", "angular_speed")
    speeds = {name: scale * getattr(protocol.push, name) for name in names}
    return msgspec.structs.replace(
        protocol,
        noise=scaled(protocol.noise),
        push=msgspec.structs.replace(protocol.push, **speeds),
        randomization=scaled(protocol.randomization, friction=slide, gain=1.0, motor_strength=1.0),
    )


def sample_episodes(
    protocol: EvalProtocol,
    target_set: TargetSet,
    count: int,
    rng: np.random.Generator,
    curriculum: float = 1.0,
    undisturbed: float = 0.0,
) -> EpisodeSamples:
    """Sample episodes with the distributions of an evaluation's manifest, on the host.

    Args:
        protocol: Protocol of the episodes.
        target_set: Targets that episodes pick from.
        count: Number of episodes.
        rng: Random generator.
        curriculum: Completed fraction in [0, 1] of the curriculum over strata.
        undisturbed: Probability of an episode of the nominal robot at rest, without pushes, noise and
            randomization.

    Returns:
        Samples of `count` episodes.
    """
    spread = protocol.randomization
    leg_q = rng.uniform(-spread.leg_q, spread.leg_q, (count, NUM_LEG_JOINTS))
    velocity = np.repeat([spread.base_lin_vel, spread.base_ang_vel], 3)
    push_step, push_vel = sample_pushes(protocol, count, rng)
    columns = dict(
        base_height=np.array([resting_height(protocol.robot, q) for q in leg_q]),
        friction=rng.uniform(*spread.friction, count),
        base_mass=rng.uniform(*spread.base_mass, count),
        base_vel=rng.uniform(-velocity, velocity, (count, 6)),
        leg_q=leg_q,
        leg_qd=rng.uniform(-spread.leg_qd, spread.leg_qd, (count, NUM_LEG_JOINTS)),
        kp_scale=rng.uniform(*spread.gain, (count, NUM_JOINTS)),
        kd_scale=rng.uniform(*spread.gain, (count, NUM_JOINTS)),
    )
    columns |= dict(
        payload=rng.uniform(*spread.payload, count),
        payload_offset=rng.uniform(-spread.payload_offset, spread.payload_offset, (count, 3)),
        motor_strength=rng.uniform(*spread.motor_strength, count),
        joint_offset=rng.uniform(-spread.joint_offset, spread.joint_offset, (count, NUM_JOINTS)),
    )
    probability, target = stratum_probabilities(protocol, curriculum), np.empty(count, dtype=np.int64)
    stratum = rng.choice(len(STRATA), count, p=probability)
    within = rng.random(count)
    for k in range(len(STRATA)):
        members = np.flatnonzero(target_set.stratum == k)
        mine = stratum == k
        target[mine] = members[(within[mine] * len(members)).astype(np.int64)]
    decay = rng.uniform(*DECAY, count)
    tilt, direction = rng.uniform(0, spread.gravity_tilt, count), rng.uniform(-np.pi, np.pi, count)
    ranges = (spread.command_delay, spread.observation_delay, spread.odometry_delay)
    delays = np.stack([rng.uniform(*limits, count) for limits in ranges], axis=1)
    calm = rng.random(count) < undisturbed
    _calm_down(protocol, columns, calm)
    push_step[calm], push_vel[calm], tilt[calm], delays[calm] = -1, 0.0, 0.0, 0.0
    reset = ResetState(**{name: torch.from_numpy(column) for name, column in columns.items()})
    others = (
        *(decay, push_step, push_vel, physics_steps(delays, protocol.physics.timestep)),
        *(tilt[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1), (~calm).astype(float)),
    )
    return EpisodeSamples(reset, target, *map(torch.from_numpy, others))


def _calm_down(protocol: EvalProtocol, columns: dict[str, Array], calm: NDArray[np.bool_]) -> None:
    """Give the episodes `calm` (K,) the initial state and parameters of undisturbed ones."""
    if calm.any():
        still = nominal(protocol, 0, 0)
        for name, column in columns.items():
            column[calm] = getattr(still, name)


def sample_pushes(
    protocol: EvalProtocol, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Sample pushes as `wbc_bench.episodes.randomization` does, for many episodes.

    Args:
        protocol: Protocol of the episodes.
        count: Number of episodes.
        rng: Random generator.

    Returns:
        Control steps (count, P) before which a push comes, -1 for none, and velocity changes (count, P, 6),
        linear in the world [m/s] and angular in the base [rad/s]. P is MAX_PUSHES, or what fits into an
        episode where training pushes more often.
    """
    push: Push = protocol.push
    most = max(MAX_PUSHES, int(protocol.episodes.horizon / push.interval[0]))
    time = np.cumsum(rng.uniform(*push.interval, (count, most)), axis=1)
    speeds = np.repeat([push.speed, push.vertical_speed, push.angular_speed], [2, 1, 3])
    horizontal = rng.uniform(-push.speed, push.speed, (count, most, 2))
    others = rng.uniform(-speeds[2:], speeds[2:], (count, most, 4))
    velocity = np.concatenate([horizontal, others], axis=2)
    none = (time >= protocol.episodes.horizon - push.quiet_end) | (not push.some)
    step = np.where(none, -1, np.round(time / protocol.control_period)).astype(np.int64)
    return step, np.where(none[..., None], 0.0, velocity)
