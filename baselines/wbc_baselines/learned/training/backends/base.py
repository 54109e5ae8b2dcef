"""What the training environment asks of its physics."""

from typing import NamedTuple, Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_bench.evaluation.simulation import Places

MAX_SPEED = 60.0  # [m/s, rad/s] of any coordinate; beyond it a simulation of 10 ms steps counts as diverged


class ResetState(NamedTuple):
    """How K episodes start: columns as those of an evaluation's manifest, float64."""

    base_height: Tensor  # (K,) [m]
    friction: Tensor  # (K,)
    base_mass: Tensor  # (K,) [kg] added
    base_vel: Tensor  # (K, 6) linear in the world [m/s], angular in the base [rad/s]
    leg_q: Tensor  # (K, 8) [rad] added to the default posture
    leg_qd: Tensor  # (K, 8) [rad/s]
    kp_scale: Tensor  # (K, 14)
    kd_scale: Tensor  # (K, 14)


class State(NamedTuple):
    """The true state of N simulations after a control step, float32, fresh tensors."""

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
        """This state, but the one before where a simulation has diverged: no sum meets a NaN."""
        rows = []
        for now, then in zip(self, before, strict=True):
            lost = self.diverged.reshape(-1, *[1] * (now.ndim - 1))
            rows.append(torch.where(lost, then, now))
        return State(*rows)._replace(diverged=self.diverged)


class Columns(NamedTuple):
    """`Places` on the device of the arrays: an index from the host would stop a GPU at every use."""

    tcp: int  # site
    soles: Tensor  # (2,) sites
    force: Tensor  # (6,) columns of the sensors
    ground: Tensor  # columns of the sensors


def columns_of(places: Places, device: torch.device) -> Columns:
    """See `Columns`."""
    indices = (places.soles, places.sole_force.ravel(), places.ground)
    return Columns(places.tcp, *(torch.as_tensor(index, device=device) for index in indices))


def state_of(
    columns: Columns, qpos: Tensor, qvel: Tensor, torque: Tensor, pos: Tensor, rot: Tensor, sensor: Tensor
) -> State:
    """The state in arrays of an engine: sites' `pos` (N, S, 3) and `rot` (N, S, 3, 3), `sensor` (N, C)."""
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
    """N simulations of the robot of one protocol."""

    num_envs: int
    device: torch.device

    def reset(self, ids: Tensor, reset: ResetState) -> State:
        """Start the simulations `ids` (K,) anew; their state, K rows."""
        ...

    def push(self, velocity_w: Tensor) -> None:
        """Add (N, 2) [m/s] to the base's horizontal velocity, zero for no push."""
        ...

    def step(self, command: Tensor) -> State:
        """Track joint commands (N, 14) [rad] for one control period."""
        ...

    def check(self) -> None:
        """Raise a `TrainingError` if a step since the last call cannot be trusted."""
        ...

    def save(self) -> dict[str, NDArray]:
        """Everything that a later step depends on."""
        ...

    def load(self, saved: dict[str, NDArray]) -> None:
        """Go on from what `save` returned."""
        ...
