"""What an episode draws besides its target: friction, mass, gains, state at reset, pushes, noise key.

Each quantity has a stream of its own, so that switching one off leaves the others as they are.
"""

import math
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol, Push
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, RobotConfig, load_robot

Array = NDArray[np.float64]


class EpisodeDraws(NamedTuple):
    """Columns of the manifest that carry the same names."""

    base_height: float  # [m]
    friction: float
    base_mass: float  # [kg]
    base_vel: Array  # (6,) [m/s], [rad/s]
    leg_q: Array  # (8,) [rad]
    leg_qd: Array  # (8,) [rad/s]
    kp_scale: Array  # (14,)
    kd_scale: Array  # (14,)
    push_time: Array  # (P,) [s], NaN for none; P is MAX_PUSHES in a manifest, see `draw_pushes`
    push_vel: Array  # (2 * P,) [m/s], zero for none
    noise_key: int
    noise_scale: float


def sample(protocol: EvalProtocol, replicate: int, episode: int) -> EpisodeDraws:
    """The draws of an episode; each depends on the seed, its quantity and the episode, on nothing else."""

    def rng(purpose: str) -> np.random.Generator:
        return stream(protocol.episodes.seed, purpose, replicate, episode)

    spread = protocol.randomization
    velocity = np.repeat([spread.base_lin_vel, spread.base_ang_vel], 3)
    leg_q = rng("leg_q").uniform(-spread.leg_q, spread.leg_q, NUM_LEG_JOINTS)
    push_time, push_vel = draw_pushes(protocol.push, protocol.episodes.horizon, rng("push"))
    return EpisodeDraws(
        base_height=resting_height(protocol.robot, leg_q),
        friction=rng("friction").uniform(*spread.friction),
        base_mass=rng("base_mass").uniform(*spread.base_mass),
        base_vel=rng("base_vel").uniform(-velocity, velocity),
        leg_q=leg_q,
        leg_qd=rng("leg_qd").uniform(-spread.leg_qd, spread.leg_qd, NUM_LEG_JOINTS),
        kp_scale=rng("kp").uniform(*spread.gain, NUM_JOINTS),
        kd_scale=rng("kd").uniform(*spread.gain, NUM_JOINTS),
        push_time=push_time,
        push_vel=push_vel,
        noise_key=noise_key(protocol, replicate, episode),
        noise_scale=1.0,
    )


def nominal(protocol: EvalProtocol, replicate: int, episode: int) -> EpisodeDraws:
    """The nominal robot at rest in the default posture, without pushes or noise."""
    return EpisodeDraws(
        base_height=resting_height(protocol.robot, np.zeros(NUM_LEG_JOINTS)),
        friction=load_robot(protocol.robot).facts.friction.slide,
        base_mass=0.0,
        base_vel=np.zeros(6),
        leg_q=np.zeros(NUM_LEG_JOINTS),
        leg_qd=np.zeros(NUM_LEG_JOINTS),
        kp_scale=np.ones(NUM_JOINTS),
        kd_scale=np.ones(NUM_JOINTS),
        push_time=np.full(MAX_PUSHES, np.nan),
        push_vel=np.zeros(2 * MAX_PUSHES),
        noise_key=noise_key(protocol, replicate, episode),
        noise_scale=0.0,
    )


def noise_key(protocol: EvalProtocol, replicate: int, episode: int) -> int:
    """Seed of the noise of an episode."""
    return int(stream(protocol.episodes.seed, "noise_key", replicate, episode).integers(2**63 - 1))


def draw_pushes(push: Push, horizon: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Times (P,) [s], NaN for none, and velocity jumps (2 * P,) [m/s], x and y of each.

    One interval after the start, one after each push, none in the quiet end. P is MAX_PUSHES, the columns of
    a manifest, or as many as fit into an episode that no manifest holds and that lasts longer.
    """
    room = math.ceil((horizon - push.quiet_end) / push.interval[0]) - 1
    most = max(MAX_PUSHES, room)
    intervals = rng.uniform(*push.interval, most)
    velocity = rng.uniform(-push.speed, push.speed, 2 * most)
    time = np.cumsum(intervals)
    none = (time >= horizon - push.quiet_end) | (push.speed == 0)
    return np.where(none, np.nan, time), np.where(np.repeat(none, 2), 0.0, velocity)


def resting_height(config: RobotConfig, leg_q: Array) -> float:
    """Height [m] of a level base whose lowest sole touches the ground, legs `leg_q` (8,) off default."""
    model, data = _model(config)
    default = load_robot(config).default_q
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *(default[:NUM_LEG_JOINTS] + leg_q), *default[NUM_LEG_JOINTS:]]
    mujoco.mj_kinematics(model, data)
    corners = [model.geom(f"foot_{side}_{k}").id for side in "LR" for k in range(4)]
    return -float((data.geom_xpos[corners, 2] - model.geom_size[corners, 0]).min())


@cache
def _model(config: RobotConfig) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = load_robot(config).model()
    return model, mujoco.MjData(model)
