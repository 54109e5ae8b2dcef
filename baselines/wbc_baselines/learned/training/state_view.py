"""Quantities that training derives from the true states of the simulations, and the networks' inputs."""

from typing import NamedTuple

import torch
from torch import Tensor

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.training.backends.base import State
from wbc_baselines.learned.training.poses import pose_errors, twice_sine
from wbc_bench.outcomes import STRATA
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS

MAX_STILL_SPEED, MAX_STILL_TURNING = 0.15, 0.3  # [m/s], [rad/s] of a base that stands still; choice
ARRIVAL_REFERENCE = 0.5  # task-progress reference below which the hand should have arrived; choice
CONTACT_FORCE = 1.0  # [N] vertical, from which a sole counts as loaded. Source: Isaac Lab's contact sensor


class DerivedState(NamedTuple):
    """Quantities of N true states, of which rates are differences over the last control period."""

    gravity_b: Tensor  # (N, 3)
    lin_vel_b: Tensor  # (N, 3) [m/s]
    ee: Tensor  # (N, 9) position [m] and two columns of the rotation, base frame
    ee_vel_b: Tensor  # (N, 6) [m/s], [rad/s] over the last control period
    feet_b: Tensor  # (N, 6) [m]
    feet_h: Tensor  # (N, 2, 2) [m] heading frame
    feet_vel_w: Tensor  # (N, 2, 2) [m/s] horizontal, over the last control period
    joint_pos: Tensor  # (N, 14) [rad] relative to the default posture
    joint_acc: Tensor  # (N, 14) [rad/s^2] over the last control period
    command: Tensor  # (N, 9)
    pos_error: Tensor  # (N,) [m]
    rot_error: Tensor  # (N,) [rad]
    upright: Tensor  # (N,) cosine of the base's tilt


class Episode(NamedTuple):
    """The current episode of each of N simulations."""

    target_pos_w: Tensor  # (N, 3) [m]
    target_rot_w: Tensor  # (N, 3, 3)
    posture: Tensor  # (N, 8) [rad] legs relative to their default, in a posture that reaches the target
    stratum: Tensor  # (N,)
    decay: Tensor  # (N,) [1/s]
    push_step: Tensor  # (N, P)
    push_vel: Tensor  # (N, P, 6) linear in the world [m/s], angular in the base [rad/s]
    dynamics: Tensor  # (N, 30) factors of kp and kd, added mass [kg], friction
    hidden: Tensor  # (N, 10) payload, its place, motor strength, IMU tilt, delays [s]
    joint_offset: Tensor  # (N, 14) [rad]
    imu_rot: Tensor  # (N, 3, 3) axes of the IMU in the base frame
    delays: Tensor  # (N, 3) physics steps: of commands, observations and odometry
    noise_scale: Tensor  # (N,) 0 for an episode without noise, else 1
    odometry_error_w: Tensor  # (N, 3) [m] so far
    step: Tensor  # (N,) completed control steps
    action: Tensor  # (N, 14) of the previous step
    d_ref: Tensor  # (N,)
    best_pos_error: Tensor  # (N,) [m]
    best_rot_error: Tensor  # (N,) [rad]
    steps_in_tolerance: Tensor  # (N,) consecutive control steps within the success tolerances
    episode_return: Tensor  # (N,) sum of the rewards so far


class Observations(NamedTuple):
    """Inputs of the networks after a step; rows that have just been reset show their new episode."""

    policy: Tensor  # (N, 67) noisy observation and command
    critic: Tensor  # (N, 174) observation without noise, command, privileged
    frame: Tensor  # (N, 57) noisy newest frame of the estimators' window
    velocity: Tensor  # (N, 3) [m/s] true, base frame
    next_observation: Tensor  # (N, 49) without noise


def derive_state(
    state: State, before: State, episode: Episode, default_q: Tensor, period: float
) -> DerivedState:
    """Derive frames, errors and rates from two consecutive states.

    Args:
        state: True states of N simulations.
        before: The states one control period earlier.
        episode: Episodes of the simulations, for their targets.
        default_q: (14,) [rad] Default posture.
        period: Control period [s].

    Returns:
        The derived quantities of N simulations.
    """
    rate = 1 / period  # [1/s]
    rot_w = rotation_from_wxyz(state.qpos[:, 3:7])
    base_w = state.qpos[:, :3]
    turned = state.ee_rot_w @ before.ee_rot_w.transpose(1, 2)
    # the sine of the angle turned in a period stands for the angle: 0.1 % off at 4 rad/s
    ee_ang_vel_w = twice_sine(turned) * (0.5 * rate)
    world = torch.cat(
        [
            torch.stack(
                [
                    state.qvel[:, :3],
                    state.ee_pos_w - base_w,
                    (state.ee_pos_w - before.ee_pos_w) * rate,
                    ee_ang_vel_w,
                    episode.target_pos_w - base_w,
                ],
                -1,
            ),
            (state.feet_pos_w - base_w[:, None]).transpose(1, 2),
            state.ee_rot_w,
            episode.target_rot_w,
        ],
        -1,
    )  # (N, 3, 13) columns in the world
    lin, ee, ee_lin, ee_ang, target, left, right, *rot_b = (rot_w.transpose(1, 2) @ world).unbind(-1)
    feet_xy = (state.feet_pos_w - base_w[:, None])[..., :2]
    forward = torch.nn.functional.normalize(rot_w[:, :2, 0], dim=-1)[:, None]
    feet_h = torch.stack(
        [
            (feet_xy * forward).sum(-1),
            feet_xy[..., 1] * forward[..., 0] - feet_xy[..., 0] * forward[..., 1],
        ],
        -1,
    )
    pos_error, rot_error = pose_errors(
        state.ee_pos_w, state.ee_rot_w, episode.target_pos_w, episode.target_rot_w
    )
    return DerivedState(
        gravity_b=-rot_w[:, 2],
        lin_vel_b=lin,
        ee=torch.cat([ee, rot_b[0], rot_b[1]], -1),
        ee_vel_b=torch.cat([ee_lin, ee_ang], -1),
        feet_b=torch.cat([left, right], -1),
        feet_h=feet_h,
        feet_vel_w=(state.feet_pos_w - before.feet_pos_w)[..., :2] * rate,
        joint_pos=state.qpos[:, 7:] - default_q,
        joint_acc=(state.qvel[:, 6:] - before.qvel[:, 6:]) * rate,
        command=torch.cat([target, rot_b[3], rot_b[4]], -1),
        pos_error=pos_error,
        rot_error=rot_error,
        upright=rot_w[:, 2, 2],
    )


def true_frame(state: State, derived: DerivedState) -> Tensor:
    """Assemble the newest frame (N, 57) of the window from true values."""
    ang_vel, joint_vel = state.qvel[:, 3:6], state.qvel[:, 6:]
    return inputs.history_frame(
        ang_vel, derived.gravity_b, derived.joint_pos, joint_vel, state.torque, derived.ee
    )


def observe(
    state: State, derived: DerivedState, episode: Episode, frame: Tensor, command: Tensor
) -> Observations:
    """Assemble the inputs of policy, critic and estimator.

    Args:
        state: True states of N simulations.
        derived: What `derive_state` made of them.
        episode: Episodes of the simulations.
        frame: (N, 57) Newest frame as the sensors show it.
        command: (N, 9) Target as the odometry places it.

    Returns:
        Inputs of the networks; the critic's and the estimator's targets are true, the others measured.
    """
    ang_vel, joint_vel = state.qvel[:, 3:6], state.qvel[:, 6:]
    true = true_frame(state, derived)
    hidden = episode.hidden
    privileged = inputs.privileged(
        derived.lin_vel_b,
        state.torque,
        derived.joint_acc,
        state.qpos[:, 2],
        derived.ee_vel_b[:, :3],
        derived.ee_vel_b[:, 3:],
        derived.feet_b,
        episode.dynamics[:, :NUM_JOINTS],
        episode.dynamics[:, NUM_JOINTS : 2 * NUM_JOINTS],
        episode.dynamics[:, -2],
        episode.dynamics[:, -1],
        state.foot_force_w.flatten(1),
        *(hidden[:, 0], hidden[:, 1:4], hidden[:, 4], episode.joint_offset, hidden[:, 5:7], hidden[:, 7:10]),
        odometry_error_b=in_base(state, episode.odometry_error_w),
    )
    return Observations(
        policy=torch.cat([_observation(frame, episode), command], -1),
        critic=torch.cat([_observation(true, episode), derived.command, privileged], -1),
        frame=frame,
        velocity=derived.lin_vel_b,
        next_observation=inputs.next_observation(
            ang_vel, derived.gravity_b, derived.joint_pos, joint_vel, derived.ee, derived.feet_b
        ),
    )


def leg_posture_error(state: State, derived: DerivedState, episode: Episode, tolerance: float) -> Tensor:
    """Compute how far the legs are from a posture that reaches the target, where they should change.

    This is where a robot stands still on both feet, its target requires no step, and its hand is late.

    Args:
        state: True states of N simulations.
        derived: What `derive_state` made of them.
        episode: Episodes of the simulations.
        tolerance: Position error [m] within which the hand has arrived.

    Returns:
        Joint angles to the wanted posture (N, 8) [rad]; 0 for all other robots.
    """
    loaded = (state.foot_force_w[..., 2].abs() > CONTACT_FORCE).all(-1)
    speed = torch.linalg.vector_norm(state.qvel[:, :3], dim=-1)
    turning = torch.linalg.vector_norm(state.qvel[:, 3:6], dim=-1)
    still = loaded & (speed < MAX_STILL_SPEED) & (turning < MAX_STILL_TURNING)
    late = (episode.d_ref < ARRIVAL_REFERENCE) & (derived.pos_error > tolerance)
    in_place = episode.stratum != STRATA.index("step")
    error = episode.posture - derived.joint_pos[:, :NUM_LEG_JOINTS]
    return torch.where((still & late & in_place)[:, None], error, 0.0)


def in_base(state: State, vector_w: Tensor) -> Tensor:
    """Rotate vectors (N, 3) of the world into the base frame."""
    return torch.einsum("nji,nj->ni", rotation_from_wxyz(state.qpos[:, 3:7]), vector_w)


def rotation_from_wxyz(quat: Tensor) -> Tensor:
    """Convert unit quaternions (N, 4) to matrices (N, 3, 3), as `wbc_bench.rotations.matrix_from_wxyz`."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _observation(frame: Tensor, episode: Episode) -> Tensor:
    """The observation (N, 58), from the columns that it shares with a frame of the window (N, 57)."""
    ang_vel, gravity, joint_pos, joint_vel, _, ee = frame.split([3, 3, *[NUM_JOINTS] * 3, 9], -1)
    return inputs.observation(ang_vel, gravity, joint_pos, joint_vel, episode.action, ee, episode.d_ref)
