"""What an episode of training draws: the evaluation's quantities and ranges, many episodes at once."""

from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.training.backends.base import Start
from wbc_baselines.learned.training.target_set import TargetPool
from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol, Push, WorkspaceTargets
from wbc_bench.episodes.randomization import resting_height
from wbc_bench.outcomes import STRATA
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, load_robot

Array = NDArray[np.float64]
DECAY = (0.5, 1.4)  # [1/s] v_ref in training. Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
# Shares of arm, posture and step at the start of a curriculum; choice. It ends at the protocol's weights.
FIRST_SHARES = np.array([0.6, 0.3, 0.1])


class Draws(NamedTuple):
    """K episodes."""

    start: Start
    target: NDArray[np.int64]  # (K,) row of the pool
    decay: Tensor  # (K,) [1/s]
    push_step: Tensor  # (K, P) control step before which it comes, -1 for none
    push_vel: Tensor  # (K, P, 2) [m/s]


def shares(protocol: EvalProtocol, curriculum: float) -> Array:
    """Shares (3,) of the strata when a part `curriculum` in [0, 1] of the ramp is done."""
    assert isinstance(protocol.targets, WorkspaceTargets)
    weights = protocol.targets.weights
    last = np.array([float(weights.get(name, 0)) for name in STRATA])
    return FIRST_SHARES * (1 - curriculum) + last / last.sum() * curriculum


def weakened(protocol: EvalProtocol, severity: float) -> EvalProtocol:
    """A protocol with a part of its noise, pushes and randomisation: none at 0, all at 1."""
    if severity == 1.0:
        return protocol

    def part(struct: Any, **neutral: float) -> Any:
        """Every field on its way from what leaves the robot alone, 0 unless named."""
        found = {}
        for name in struct.__struct_fields__:
            value, still = np.array(getattr(struct, name)), neutral.get(name, 0.0)
            found[name] = (still + severity * (value - still)).tolist()
        return msgspec.convert(found, type(struct))

    slide = load_robot(protocol.robot).facts.friction.slide
    return msgspec.structs.replace(
        protocol,
        noise=part(protocol.noise),
        push=msgspec.structs.replace(protocol.push, speed=severity * protocol.push.speed),
        randomization=part(protocol.randomization, friction=slide, gain=1.0),
    )


def draw_starts(
    protocol: EvalProtocol, pool: TargetPool, count: int, rng: np.random.Generator, curriculum: float = 1.0
) -> Draws:
    """`count` episodes; the distributions are those of an evaluation's manifest (wbc_bench.randomization).

    On the host.
    """
    spread = protocol.randomization
    leg_q = rng.uniform(-spread.leg_q, spread.leg_q, (count, NUM_LEG_JOINTS))
    velocity = np.repeat([spread.base_lin_vel, spread.base_ang_vel], 3)
    push_step, push_vel = draw_pushes(protocol, count, rng)
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
    share, target = shares(protocol, curriculum), np.empty(count, dtype=np.int64)
    stratum = rng.choice(len(STRATA), count, p=share)
    within = rng.random(count)
    for k in range(len(STRATA)):
        members = np.flatnonzero(pool.stratum == k)
        mine = stratum == k
        target[mine] = members[(within[mine] * len(members)).astype(np.int64)]
    start = Start(**{name: torch.from_numpy(column) for name, column in columns.items()})
    decay = rng.uniform(*DECAY, count)
    return Draws(start, target, *map(torch.from_numpy, (decay, push_step, push_vel)))


def draw_pushes(
    protocol: EvalProtocol, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Steps (count, P) and jumps (count, P, 2) [m/s], as `randomization.draw_pushes`.

    P is MAX_PUSHES, or what fits into an episode where training asks for more.
    """
    push: Push = protocol.push
    most = max(MAX_PUSHES, int(protocol.episodes.horizon / push.interval[0]))
    time = np.cumsum(rng.uniform(*push.interval, (count, most)), axis=1)
    velocity = rng.uniform(-push.speed, push.speed, (count, most, 2))
    none = (time >= protocol.episodes.horizon - push.quiet_end) | (push.speed == 0)
    step = np.where(none, -1, np.round(time / protocol.control_period)).astype(np.int64)
    return step, np.where(none[..., None], 0.0, velocity)
