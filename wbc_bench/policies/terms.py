"""The vocabulary of observation terms: names as in Isaac Lab and mjlab where they have one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import Signal
from wbc_bench.rotations import heading_from_gravity, rotvec_from_matrix, wxyz_from_matrix

Array = NDArray[np.float64]
Kind = Literal["vector", "joints", "pose", "plain"]
# frames that a kind of term may be given in
FRAMES: dict[Kind, tuple[str, ...]] = {
    "vector": ("base", "heading"),
    "joints": ("base",),
    "pose": ("base", "arm", "heading", "world"),
    "plain": ("base",),
}


Numbers = float | tuple[float, ...]  # one for all, or one each


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a card."""


class TermCard(Part, frozen=True):
    """One term of an observation: (value - offset) clipped, then times scale."""

    term: str  # name of the vocabulary
    joints: tuple[str, ...] = ()  # of a term of joints; the card's when empty
    frame: Literal["base", "arm", "heading", "world"] = "base"  # of a term of positions or rotations
    layout: Literal["columns", "rows", "interleaved"] = "columns"  # of rotations of six numbers
    scale: Numbers = 1.0
    offset: Numbers = 0.0
    clip: tuple[float, float] | None = None
    history: int = 0  # frames; the group's when 0
    value: tuple[float, ...] = ()  # of `constant`, and of `velocity_commands` where no follower gives them
    frequency: float = 1.0  # [Hz] of `gait_phase`
    phases: tuple[float, ...] = (0.0,)  # of `gait_phase`, one per leg, in turns


@dataclass(frozen=True)
class Seen:
    """What terms are computed of at one control step, in the bench's own order and frames."""

    proprioception: Any
    base_pose: Any
    ee_pos_b: Array  # (N, 3) [m] of the card's tool frame
    ee_rot_b: Array  # (N, 3, 3)
    ee_columns_b: Array  # (N, 3, 2) its first two columns as they were measured, not orthonormal
    target_pos_b: Array  # (N, 3) [m]
    target_rot_b: Array  # (N, 3, 3)
    default_q: Array  # (14,) [rad] of the card
    last_action: Array  # (N, A)
    time: float  # [s]
    phase_reference: Array  # (N,)
    arm_mount_b: Array  # (3,) [m]
    quaternion: str
    velocity: Any = None  # (N, 3) [m/s, m/s, rad/s] of the follower

    def heading(self) -> Array:
        """(N, 3, 3) the base in the frame that has its heading and is level, from the measured gravity."""
        return heading_from_gravity(self.proprioception.gravity_b)

    def in_frame(self, pos: Array, rot: Array, frame: str) -> tuple[Array, Array]:
        """A pose of the base frame in another frame."""
        if frame == "arm":
            return pos - self.arm_mount_b, rot
        if frame == "heading":
            turn = self.heading()
            return np.einsum("nij,nj->ni", turn, pos), turn @ rot
        if frame == "world":
            turn = self.base_pose.rot_w
            return np.einsum("nij,nj->ni", turn, pos) + self.base_pose.pos_w, turn @ rot
        return pos, rot

    def ee(self, frame: str) -> tuple[Array, Array]:
        return self.in_frame(self.ee_pos_b, self.ee_rot_b, frame)

    def ee_six(self, card: TermCard) -> Array:
        """Six numbers (N, 6) of the end-effector's rotation, as measured where they are columns."""
        if card.layout == "rows":
            return six(self.ee(card.frame)[1], card.layout)
        return six(self.in_frame(self.ee_pos_b, self.ee_columns_b, card.frame)[1], card.layout)

    def target(self, frame: str) -> tuple[Array, Array]:
        return self.in_frame(self.target_pos_b, self.target_rot_b, frame)

    def quat(self, rot: Array) -> Array:
        """Quaternions (N, 4) with w >= 0, in the order of the card."""
        quat = wxyz_from_matrix(rot)
        quat = np.where(quat[:, :1] < 0, -quat, quat)
        return quat if self.quaternion == "wxyz" else np.roll(quat, -1, axis=1)

    def vector(self, value: Array, frame: str) -> Array:
        return value if frame == "base" else np.einsum("nij,nj->ni", self.heading(), value)


def six(rot: Array, layout: str) -> Array:
    """Six numbers (N, 6) of rotations: two columns, two rows, or the two columns row by row."""
    if layout == "columns":
        return np.concatenate([rot[:, :, 0], rot[:, :, 1]], axis=1)
    return rot[:, :2].reshape(-1, 6) if layout == "rows" else rot[:, :, :2].reshape(-1, 6)


class Term(NamedTuple):
    """A word of the vocabulary."""

    kind: Kind
    size: int | None  # columns; None where the card says
    unit: str
    text: str
    signals: tuple[Signal, ...]
    compute: Callable[[Seen, TermCard], Array]  # (N, size); of joints (N, 14)


def _ones(seen: Seen) -> Array:
    return np.ones((len(seen.last_action), 1))


def _gait(seen: Seen, card: TermCard) -> Array:
    angle = 2 * np.pi * (card.frequency * seen.time + np.array(card.phases))
    return _ones(seen) * np.column_stack([np.sin(angle), np.cos(angle)]).ravel()


_P: tuple[Signal, ...] = ("proprioception",)
_E: tuple[Signal, ...] = ("ee_pose",)
_B: tuple[Signal, ...] = ("base_pose",)
TERMS: dict[str, Term] = {
    "base_ang_vel": Term(
        "vector",
        3,
        "rad/s",
        "angular velocity of the base",
        _P,
        lambda s, c: s.vector(s.proprioception.base_ang_vel_b, c.frame),
    ),
    "projected_gravity": Term(
        "plain",
        3,
        "1",
        "direction of gravity in the base frame, (0, 0, -1) when upright",
        _P,
        lambda s, c: s.proprioception.gravity_b,
    ),
    "base_lin_vel": Term(
        "plain",
        3,
        "m/s",
        "true linear velocity of the base, in the base frame",
        _B,
        lambda s, c: np.einsum("nji,nj->ni", s.base_pose.rot_w, s.base_pose.lin_vel_w),
    ),
    "base_height": Term(
        "plain", 1, "m", "true height of the base", _B, lambda s, c: s.base_pose.pos_w[:, 2:]
    ),
    "base_quat": Term(
        "plain", 4, "1", "true orientation of the base", _B, lambda s, c: s.quat(s.base_pose.rot_w)
    ),
    "joint_pos": Term("joints", None, "rad", "joint positions", _P, lambda s, c: s.proprioception.joint_pos),
    "joint_pos_rel": Term(
        "joints",
        None,
        "rad",
        "joint positions about the default posture",
        _P,
        lambda s, c: s.proprioception.joint_pos - s.default_q,
    ),
    "joint_vel": Term(
        "joints", None, "rad/s", "joint velocities", _P, lambda s, c: s.proprioception.joint_vel
    ),
    "joint_vel_rel": Term(
        "joints", None, "rad/s", "joint velocities, about zero", _P, lambda s, c: s.proprioception.joint_vel
    ),
    "joint_effort": Term(
        "joints", None, "N m", "measured joint torques", _P, lambda s, c: s.proprioception.joint_torque
    ),
    "last_action": Term(
        "plain", None, "1", "the action before, zero at first", (), lambda s, c: s.last_action
    ),
    "ee_pos": Term("pose", 3, "m", "position of the end-effector", _E, lambda s, c: s.ee(c.frame)[0]),
    "ee_rot6": Term(
        "pose", 6, "1", "orientation of the end-effector, six numbers", _E, lambda s, c: s.ee_six(c)
    ),
    "ee_quat": Term(
        "pose", 4, "1", "orientation of the end-effector", _E, lambda s, c: s.quat(s.ee(c.frame)[1])
    ),
    "ee_pose": Term(
        "pose",
        7,
        "m, 1",
        "position and quaternion of the end-effector",
        _E,
        lambda s, c: np.hstack([s.ee(c.frame)[0], s.quat(s.ee(c.frame)[1])]),
    ),
    "target_pos": Term("pose", 3, "m", "position of the target", (), lambda s, c: s.target(c.frame)[0]),
    "target_rot6": Term(
        "pose",
        6,
        "1",
        "orientation of the target, six numbers",
        (),
        lambda s, c: six(s.target(c.frame)[1], c.layout),
    ),
    "target_quat": Term(
        "pose", 4, "1", "orientation of the target", (), lambda s, c: s.quat(s.target(c.frame)[1])
    ),
    "ee_target": Term(
        "pose",
        7,
        "m, 1",
        "position and quaternion of the target",
        (),
        lambda s, c: np.hstack([s.target(c.frame)[0], s.quat(s.target(c.frame)[1])]),
    ),
    "ee_pos_error": Term(
        "pose",
        3,
        "m",
        "target position less that of the end-effector",
        _E,
        lambda s, c: s.target(c.frame)[0] - s.ee(c.frame)[0],
    ),
    "ee_rot_error": Term(
        "pose",
        3,
        "rad",
        "rotation vector from the end-effector to the target",
        _E,
        lambda s, c: rotvec_from_matrix(s.target(c.frame)[1] @ np.swapaxes(s.ee(c.frame)[1], 1, 2)),
    ),
    "velocity_commands": Term(
        "plain",
        None,
        "m/s, rad/s",
        "a walking policy's (vx, vy, wz) in the heading frame, of the follower, or the constant `value`",
        (),
        lambda s, c: _ones(s) * np.array(c.value) if c.value else s.velocity,
    ),
    "constant": Term(
        "plain", None, "1", "the numbers of `value`", (), lambda s, c: _ones(s) * np.array(c.value)
    ),
    "gait_phase": Term(
        "plain", None, "1", "sine and cosine of a clock of `frequency` for each of `phases`", (), _gait
    ),
    "episode_time": Term("plain", 1, "s", "time since the start", (), lambda s, c: _ones(s) * s.time),
    "phase_reference": Term(
        "plain",
        1,
        "1",
        "the paper's task-progress reference: initial error that decays with time",
        _E,
        lambda s, c: s.phase_reference[:, None],
    ),
}
