"""The interface between the training environment and a physics engine."""

from typing import NamedTuple, Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_bench.evaluation.simulation import Places

MAX_SPEED = 60.0  # [m/s, rad/s] of any coordinate; beyond it a simulation of 10 ms steps counts as diverged


class ResetState(NamedTuple):
    """The random initial conditions and parameters of K episodes, named as in a manifest, float64."""

    base_height: Tensor  # (K,) [m]
    friction: Tensor  # (K,)
    base_mass: Tensor  # (K,) [kg] added
    base_vel: Tensor  # (K, 6) linear in the world [m/s], angular in the base [rad/s]
    leg_q: Tensor  # (K, 8) [rad] added to the default posture
    leg_qd: Tensor  # (K, 8) [rad/s]
    kp_scale: Tensor  # (K, 14)
    kd_scale: Tensor  # (K, 14)
    payload: Tensor  # (K,) [kg]
    payload_offset: Tensor  # (K, 3) [m]
    motor_strength: Tensor  # (K,)
    joint_offset: Tensor  # (K, 14) [rad]


class State(NamedTuple):
    """The true state of N simulations after a control step, float32, in tensors of its own."""

    qpos: Tensor  # (N, 21) position [m], wxyz, joints [rad]
    qvel: Tensor  # (N, 20) linear in the world [m/s], angular in the base [rad/s], joints [rad/s]
    torque: Tensor  # (N, 14) [N m]
    ee_pos_w: Tensor  # (N, 3) [m]
    ee_rot_w: Tensor  # (N, 3, 3)
    feet_pos_w: Tensor  # (N, 2, 3) [m] left, right sole
    feet_up_w: Tensor  # (N, 2, 2) horizontal part of the soles' normal
    foot_force_w: Tensor  # (N, 2, 3) [N] one physics step late
    ground_contact: Tensor  # (N,) bool, one physics step late
    diverged: Tensor  # (N,) bool

    def put(self, ids: Tensor, rows: "State") -> None:
        """Overwrite the simulations `ids` (K,) with the rows of another state."""
        for mine, theirs in zip(self, rows, strict=True):
            mine[ids] = theirs

    def where_sound(self, before: "State") -> "State":
        """Replace the rows of diverged simulations by those of the state before, so that sums stay finite."""
        rows = []
        for now, then in zip(self, before, strict=True):
            lost = self.diverged.reshape(-1, *[1] * (now.ndim - 1))
            rows.append(torch.where(lost, then, now))
        return State(*rows)._replace(diverged=self.diverged)


class Reading(NamedTuple):
    """What motors, encoders and IMU of N simulations measure; the first fields of a `State`."""

    qpos: Tensor  # (N, 21)
    qvel: Tensor  # (N, 20)
    torque: Tensor  # (N, 14)


class Columns(NamedTuple):
    """`Places` on the device of the arrays, because an index from the host would synchronize a GPU."""

    tcp: int  # site
    soles: Tensor  # (2,) sites
    force: Tensor  # (6,) columns of the sensors
    ground: Tensor  # columns of the sensors


def columns_of(places: Places, device: torch.device) -> Columns:
    """Move `Places` to a device, see `Columns`."""
    indices = (places.soles, places.sole_force.ravel(), places.ground)
    return Columns(places.tcp, *(torch.as_tensor(index, device=device) for index in indices))


def state_of(
    columns: Columns, qpos: Tensor, qvel: Tensor, torque: Tensor, pos: Tensor, rot: Tensor, sensor: Tensor
) -> State:
    """Assemble the state from the arrays of an engine.

    Args:
        columns: Indices into the arrays.
        qpos: (N, 21) Positions.
        qvel: (N, 20) Velocities.
        torque: (N, 14) [N m] Joint torques.
        pos: (N, S, 3) [m] Positions of the sites.
        rot: (N, S, 3, 3) Rotations of the sites.
        sensor: (N, C) Values of the sensors.

    Returns:
        The state of N simulations.
    """
    tcp, soles, force, ground = columns
    return State(
        qpos=qpos,
        qvel=qvel,
        torque=torque,
        ee_pos_w=pos[:, tcp].contiguous(),
        ee_rot_w=rot[:, tcp].contiguous(),
        feet_pos_w=pos[:, soles],
        feet_up_w=rot[:, soles, :2, 2].contiguous(),
        foot_force_w=sensor[:, force].unflatten(-1, (2, 3)),
        ground_contact=(sensor[:, ground] > 0).any(-1),
        diverged=~((qvel.abs() < MAX_SPEED).all(-1) & qpos.isfinite().all(-1)),
    )


class Backend(Protocol):
    """N parallel simulations of the robot of one protocol."""

    num_envs: int
    device: torch.device

    def reset(self, ids: Tensor, reset: ResetState) -> State:
        """Reset the simulations `ids` (K,) and return their state, K rows."""
        ...

    def push(self, velocity: Tensor) -> None:
        """Add to the base's velocity (N, 6), in the world [m/s] and in the base [rad/s]; 0 for no push."""
        ...

    def step(self, commands: Tensor) -> tuple[list[Reading], State]:
        """Advance by one control period.

        Args:
            commands: (K, N, 14) [rad] Joint commands for one period, each for an equal part of its physics
                steps: 1 of them, or one per physics step.

        Returns:
            What is measured after each command but the last, and the state at the end.
        """
        ...

    def check(self) -> None:
        """Raise a `TrainingError` if a step since the last call is invalid."""
        ...

    def save(self) -> dict[str, NDArray]:
        """Return everything that a later step depends on."""
        ...

    def load(self, saved: dict[str, NDArray]) -> None:
        """Continue from what `save` returned."""
        ...
