"""What the sensors of training's robots show, and when: late, and off by what an episode hides.

The counterpart in PyTorch of `observation` and `delays` of `wbc_bench.evaluation`; a test compares them.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.training.arm_ik import ArmKinematics
from wbc_baselines.learned.training.backends.base import Reading, State
from wbc_baselines.learned.training.state_view import Episode, rotation_from_wxyz
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS


class Past:
    """The last values of N simulations, the newest first."""

    def __init__(self, depth: int, first: Tensor) -> None:
        """Fill `depth` places with the first values (N, W)."""
        self.values = first[None].repeat(depth, 1, 1)  # (depth, N, W)
        self._rows = torch.arange(len(first), device=first.device)

    def push(self, value: Tensor) -> None:
        """Append the newest values (N, W) and drop the oldest."""
        self.values = torch.cat([value[None], self.values[:-1]])

    def at(self, age: Tensor) -> Tensor:
        """Return the values (N, W) that are `age` (N,) places older than the newest."""
        return self.values[age, self._rows]

    def restart(self, ids: Tensor, first: Tensor) -> None:
        """Forget the past of the simulations `ids` (K,), which begin with the values (K, W)."""
        self.values[:, ids] = first


def command_age(offset: int, delay: Tensor, decimation: int) -> Tensor:
    """Compute which command acts.

    Args:
        offset: Physics steps since the start of the control step.
        delay: (N,) Physics steps from a command to the motors.
        decimation: Physics steps per control step.

    Returns:
        How many control steps ago (N,) the command was given that acts now.
    """
    return -torch.div(offset - delay, decimation, rounding_mode="floor")


def measure(reading: Reading | State, episode: Episode, default_q: Tensor, arm: ArmKinematics) -> Tensor:
    """Assemble what the sensors would show at once.

    Args:
        reading: What is measured of N simulations.
        episode: Episodes of the simulations, for the errors of encoders and IMU.
        default_q: (14,) [rad] Default posture.
        arm: Kinematics that place the hand by the encoders.

    Returns:
        The newest frame of the window without noise, and position and rotation of the base (N, 57 + 3 + 9).
    """
    qpos, qvel = reading.qpos, reading.qvel
    rot_w = rotation_from_wxyz(qpos[:, 3:7])
    gyro, gravity = torch.einsum("nji,knj->kni", episode.imu_rot, torch.stack([qvel[:, 3:6], -rot_w[:, 2]]))
    encoders = qpos[:, 7:] + episode.joint_offset
    pos_b, rot_b = arm.pose(encoders[:, NUM_LEG_JOINTS:])
    ee = torch.cat([pos_b, rot_b[..., 0], rot_b[..., 1]], -1)
    frame = inputs.history_frame(gyro, gravity, encoders - default_q, qvel[:, 6:], reading.torque, ee)
    return torch.cat([frame, qpos[:, :3], rot_w.flatten(1)], -1)


def noise_half_widths(protocol: EvalProtocol) -> NDArray[np.float64]:
    """Return the half-widths (57,) of the uniform noise on a frame of the window."""
    noise, joints = protocol.noise, NUM_JOINTS
    widths = {"base_ang_vel": 3, "gravity": 3, "joint_pos": joints, "joint_vel": joints}
    widths |= {"joint_torque": joints, "ee_pos": 3, "ee_rot": 6}
    return np.concatenate([np.full(width, getattr(noise, name)) for name, width in widths.items()])


def sample_noise(
    protocol: EvalProtocol, steps: int, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Sample the noise of several control steps.

    Args:
        protocol: Protocol of the episodes.
        steps: Number of control steps.
        count: Number of simulations.
        generator: Generator, on the device of the results.

    Returns:
        Noise of the frames (steps, N, 57), and steps of the odometry's random walk (steps, N, 3) [m].
    """
    device = generator.device
    half = torch.tensor(noise_half_widths(protocol), dtype=torch.float32, device=device)
    noise = torch.rand((steps, count, len(half)), generator=generator, device=device)
    walk = protocol.randomization.odometry_drift * protocol.control_period**0.5
    drift = torch.zeros((steps, count, 3), device=device)
    if walk:
        drift.normal_(0.0, walk, generator=generator)
    return noise.mul_(2).sub_(1).mul_(half), drift


def measured_command(measured: Tensor, episode: Episode) -> Tensor:
    """Put the targets into the base frame.

    Args:
        measured: (N, 69) What `measure` made of the states that the odometry knows.
        episode: Episodes of the simulations, for their targets and the errors of the odometry.

    Returns:
        Commands (N, 9).
    """
    base_w, rot_w = measured[:, -12:-9], measured[:, -9:].unflatten(-1, (3, 3))
    away = episode.target_pos_w - base_w - episode.odometry_error_w
    return inputs.command(
        torch.einsum("nji,nj->ni", rot_w, away), rot_w.transpose(1, 2) @ episode.target_rot_w
    )
