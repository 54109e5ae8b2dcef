"""What an episode draws besides its target: state at reset, robot and ground, pushes, disturbances, noise.

Each quantity has a stream of its own, so that switching one off leaves the others as they are.
"""

import math
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol, Push
from wbc_bench.episodes.rows import EpisodeManifest, neutral
from wbc_bench.episodes.terrain import TERRAIN_SPAN, highest_near
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, RobotConfig, load_robot
from wbc_bench.rotations import matrix_from_rotvec

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
    push_vel_z: Array  # (P,) [m/s]
    push_ang_vel: Array  # (3 * P,) [rad/s]
    command_delay: float  # [s]
    observation_delay: float  # [s]
    odometry_delay: float  # [s]
    odometry_drift: float  # [m/sqrt(s)]
    payload: float  # [kg]
    payload_offset: Array  # (3,) [m]
    motor_strength: float
    joint_offset: Array  # (14,) [rad]
    imu_tilt: Array  # (2,) [rad] rotation vector
    slope: Array  # (2,) [rad] rotation vector
    terrain_offset: Array  # (2,) [m]


def sample(protocol: EvalProtocol, replicate: int, episode: int) -> EpisodeDraws:
    """The draws of an episode; each depends on the seed, its quantity and the episode, on nothing else."""

    def rng(purpose: str) -> np.random.Generator:
        return stream(protocol.episodes.seed, purpose, replicate, episode)

    spread = protocol.randomization
    velocity = np.repeat([spread.base_lin_vel, spread.base_ang_vel], 3)
    leg_q = rng("leg_q").uniform(-spread.leg_q, spread.leg_q, NUM_LEG_JOINTS)
    push_time, push_vel = draw_pushes(protocol.push, protocol.episodes.horizon, rng("push"))
    push_vel_z, push_ang_vel = draw_turning_pushes(protocol.push, push_time, rng("push_turn"))
    slope = _tilt(spread.slope, rng("slope"))
    terrain_offset = rng("terrain").uniform(-1, 1, 2) * (TERRAIN_SPAN if spread.step_height > 0 else 0.0)
    return EpisodeDraws(
        base_height=resting_height(protocol.robot, leg_q, slope, spread.step_height, terrain_offset),
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
        push_vel_z=push_vel_z,
        push_ang_vel=push_ang_vel,
        command_delay=rng("command_delay").uniform(*spread.command_delay),
        observation_delay=rng("observation_delay").uniform(*spread.observation_delay),
        odometry_delay=rng("odometry_delay").uniform(*spread.odometry_delay),
        odometry_drift=spread.odometry_drift,
        payload=rng("payload").uniform(*spread.payload),
        payload_offset=rng("payload_offset").uniform(-spread.payload_offset, spread.payload_offset, 3),
        motor_strength=rng("motor_strength").uniform(*spread.motor_strength),
        joint_offset=rng("joint_offset").uniform(-spread.joint_offset, spread.joint_offset, NUM_JOINTS),
        imu_tilt=_tilt(spread.gravity_tilt, rng("gravity_tilt")),
        slope=slope,
        terrain_offset=terrain_offset,
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
        **{name: column[0] for name, column in neutral(1).items()},
    )


def draw(protocol: EvalProtocol, replicate: int, episode: int, condition: str) -> EpisodeDraws:
    """What an episode draws under its condition: nothing if that is `nominal`."""
    return (nominal if condition == "nominal" else sample)(protocol, replicate, episode)


def draw_columns(protocol: EvalProtocol, rows: EpisodeManifest) -> dict[str, Array]:
    """Columns of a manifest that the episodes of `rows` draw besides their targets."""
    keys = zip(rows.replicate.tolist(), rows.episode.tolist(), rows.condition, strict=True)
    draws = (draw(protocol, replicate, episode, condition) for replicate, episode, condition in keys)
    columns = zip(EpisodeDraws._fields, zip(*draws, strict=True), strict=True)
    return {name: np.array(values) for name, values in columns}


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
    none = (time >= horizon - push.quiet_end) | (not push.some)
    return np.where(none, np.nan, time), np.where(np.repeat(none, 2), 0.0, velocity)


def draw_turning_pushes(push: Push, time: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Vertical (P,) [m/s] and angular (3 * P,) [rad/s] jumps of the pushes at `time` (P,), zero for none."""
    vertical = rng.uniform(-push.vertical_speed, push.vertical_speed, len(time))
    angular = rng.uniform(-push.angular_speed, push.angular_speed, 3 * len(time))
    none = np.isnan(time)
    return np.where(none, 0.0, vertical), np.where(np.repeat(none, 3), 0.0, angular)


def _tilt(largest: float, rng: np.random.Generator) -> Array:
    """Rotation vector (2,) [rad] about a horizontal axis of any direction, by up to `largest`."""
    angle, direction = rng.uniform(0, 1) * largest, rng.uniform(-np.pi, np.pi)
    return angle * np.array([np.cos(direction), np.sin(direction)])


def resting_height(
    config: RobotConfig,
    leg_q: Array,
    slope: Array | None = None,
    step_height: float = 0.0,
    terrain_offset: Array | None = None,
) -> float:
    """Height [m] of a level base whose lowest sole touches the ground, legs `leg_q` (8,) off default.

    The ground is level, or a plane through the origin turned by `slope` (2,) [rad] whose bumps of up to
    `step_height` [m] are displaced by `terrain_offset` (2,) [m].
    """
    model, data = _model(config)
    default = load_robot(config).default_q
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *(default[:NUM_LEG_JOINTS] + leg_q), *default[NUM_LEG_JOINTS:]]
    mujoco.mj_kinematics(model, data)
    corners = [model.geom(f"foot_{side}_{k}").id for side in "LR" for k in range(4)]
    centre, radius = data.geom_xpos[corners], model.geom_size[corners, 0]
    if (slope is None or not slope.any()) and step_height == 0:
        return -float((centre[:, 2] - radius).min())
    rot = matrix_from_rotvec(np.array([*(np.zeros(2) if slope is None else slope), 0.0]))
    # along the vertical: the distance of a sphere from the plane grows by the normal's upward part
    bump = highest_near(centre @ rot, step_height, terrain_offset)
    return float(((radius + bump - centre @ rot[:, 2]) / rot[2, 2]).max())


@cache
def _model(config: RobotConfig) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = load_robot(config).model()
    return model, mujoco.MjData(model)
