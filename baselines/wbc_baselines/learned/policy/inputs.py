"""The inputs of policy, critic and estimators: the meaning of every column, and their assembly.

The layouts below are the only definition of the dimensions; `wbc-bench list --inputs` prints them.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot import NUM_JOINTS

if TYPE_CHECKING:  # an evaluation assembles arrays, where torch may not be installed
    from torch import Tensor

Array = TypeVar("Array", NDArray[np.float32], "Tensor")


class Term(NamedTuple):
    """Adjacent columns of a vector."""

    name: str
    size: int
    unit: str


Layout = tuple[Term, ...]
ACTIONS = NUM_JOINTS
HISTORY = 10  # control steps in the window. Source: paper, section III-C, H = 10

_ANG_VEL = Term("base angular velocity, base frame", 3, "rad/s")
_GRAVITY = Term("projected gravity, base frame", 3, "1")
_JOINT_POS = Term("joint positions about the default posture", NUM_JOINTS, "rad")
_JOINT_VEL = Term("joint velocities", NUM_JOINTS, "rad/s")
_TORQUE = Term("joint torques", NUM_JOINTS, "N m")
_EE_POS = Term("end-effector position, base frame", 3, "m")
_EE_ROT = Term("end-effector rotation, base frame, first two columns", 6, "1")
_FEET = Term("positions of left and right sole, base frame", 6, "m")

OBSERVATION_LAYOUT: Layout = (  # Source: paper, Table I
    *(_ANG_VEL, _GRAVITY, _JOINT_POS, _JOINT_VEL),
    Term("previous action", ACTIONS, "1"),
    *(_EE_POS, _EE_ROT),
    Term("task-progress reference d_ref", 1, "1"),
)
COMMAND_LAYOUT: Layout = (  # Source: paper, eq. 1
    Term("target position, base frame", 3, "m"),
    Term("target rotation, base frame, first two columns", 6, "1"),
)
# Source: paper, section III-C
HISTORY_LAYOUT: Layout = (_ANG_VEL, _GRAVITY, _JOINT_POS, _JOINT_VEL, _TORQUE, _EE_POS, _EE_ROT)
NEXT_OBSERVATION_LAYOUT: Layout = (_ANG_VEL, _GRAVITY, _JOINT_POS, _JOINT_VEL, _EE_POS, _EE_ROT, _FEET)
PAPER_PRIVILEGED_LAYOUT: Layout = (  # Source: paper, section III-A, what the critic additionally receives
    Term("base linear velocity, base frame", 3, "m/s"),
    _TORQUE,
    Term("joint accelerations over the last control period", NUM_JOINTS, "rad/s^2"),
    Term("base height", 1, "m"),
    Term("end-effector linear velocity, base frame", 3, "m/s"),
    Term("end-effector angular velocity, base frame", 3, "rad/s"),
    _FEET,
    Term("kp factors", NUM_JOINTS, "1"),
    Term("kd factors", NUM_JOINTS, "1"),
    Term("mass added to the base", 1, "kg"),
    Term("friction coefficient", 1, "1"),
    Term("ground forces on left and right sole, world frame", 6, "N"),
)
PRIVILEGED_LAYOUT: Layout = (  # and the disturbances of `wbc_bench.episodes.protocol.Randomization` since
    *PAPER_PRIVILEGED_LAYOUT,
    Term("payload in the hand", 1, "kg"),
    Term("place of the payload from the end-effector, in the frame of its link", 3, "m"),
    Term("motor strength", 1, "1"),
    Term("errors of the encoders", NUM_JOINTS, "rad"),
    Term("tilt of the IMU about x and y", 2, "rad"),
    Term("delays of commands, observations and odometry", 3, "s"),
    Term("error of the odometry, base frame", 3, "m"),
)


def width(layout: Layout) -> int:
    """Count the columns of a layout."""
    return sum(term.size for term in layout)


def columns(layout: Layout, term: str) -> slice:
    """Find the columns of a term.

    Args:
        layout: Layout of the vector.
        term: Beginning of the term's name.

    Returns:
        Columns of the first term that matches.

    Raises:
        KeyError: There is no such term.
    """
    start = 0
    for each in layout:
        if each.name.startswith(term):
            return slice(start, start + each.size)
        start += each.size
    raise KeyError(term)


OBSERVATION = width(OBSERVATION_LAYOUT)
COMMAND = width(COMMAND_LAYOUT)
HISTORY_FRAME = width(HISTORY_LAYOUT)
NEXT_OBSERVATION = width(NEXT_OBSERVATION_LAYOUT)
PAPER_PRIVILEGED, PRIVILEGED = width(PAPER_PRIVILEGED_LAYOUT), width(PRIVILEGED_LAYOUT)
VELOCITY, LATENT = 3, 64  # of the context z = (v, xi). Source: paper, Table I
CONTEXT_MAX = VELOCITY + LATENT
CONTEXT_LAYOUT: Layout = (
    Term("estimated base linear velocity, base frame", VELOCITY, "m/s"),
    Term(
        "dynamics latent (16 in cenet; the oracle's context is the critic's privileged vector)", LATENT, "1"
    ),
)
# Source: paper, Table I and section III
assert (OBSERVATION, COMMAND, HISTORY_FRAME, NEXT_OBSERVATION, CONTEXT_MAX) == (58, 9, 57, 49, 67)
assert PAPER_PRIVILEGED == 80

LAYOUTS: dict[str, Layout] = {
    "observation": OBSERVATION_LAYOUT,
    "command": COMMAND_LAYOUT,
    "context": CONTEXT_LAYOUT,
    f"history frame (window of {HISTORY})": HISTORY_LAYOUT,
    "next observation (decoder's target, without noise)": NEXT_OBSERVATION_LAYOUT,
    "privileged (critic and oracle, without noise)": PRIVILEGED_LAYOUT,
}


def _join(layout: Layout, *parts: Array) -> Array:
    """Concatenate parts to (N, width); each may span several adjacent terms."""
    every: Any = parts
    joined: Any
    if isinstance(every[0], np.ndarray):
        joined = np.concatenate(every, axis=-1)
    else:
        import torch

        joined = torch.cat(every, dim=-1)
    if joined.shape[-1] != width(layout):
        sizes = " + ".join(str(part.shape[-1]) for part in parts)
        raise ValueError(f"{sizes} columns, the layout has {' + '.join(str(term.size) for term in layout)}")
    return joined


def observation(
    ang_vel_b: Array,
    gravity_b: Array,
    joint_pos_rel: Array,
    joint_vel: Array,
    previous_action: Array,
    ee: Array,
    d_ref: Array,
) -> Array:
    """Assemble the actor's observation (N, 58); `ee` (N, 9) is position and two columns, d_ref is (N,)."""
    parts = (ang_vel_b, gravity_b, joint_pos_rel, joint_vel, previous_action, ee, d_ref[..., None])
    return _join(OBSERVATION_LAYOUT, *parts)


def command(target_pos_b: Array, target_rot_b: Array) -> Array:
    """Assemble the command (N, 9) of a position (N, 3) [m] and a rotation (N, 3, 3). Source: paper, eq. 1."""
    return _join(COMMAND_LAYOUT, target_pos_b, target_rot_b[..., :, 0], target_rot_b[..., :, 1])


def history_frame(
    ang_vel_b: Array,
    gravity_b: Array,
    joint_pos_rel: Array,
    joint_vel: Array,
    joint_torque: Array,
    ee: Array,
) -> Array:
    """Assemble one frame (N, 57) of an estimator's window."""
    return _join(HISTORY_LAYOUT, ang_vel_b, gravity_b, joint_pos_rel, joint_vel, joint_torque, ee)


def next_observation(
    ang_vel_b: Array,
    gravity_b: Array,
    joint_pos_rel: Array,
    joint_vel: Array,
    ee: Array,
    feet_b: Array,
) -> Array:
    """Assemble the decoder's target (N, 49) from true values; feet_b (N, 6) [m] is left, then right."""
    return _join(NEXT_OBSERVATION_LAYOUT, ang_vel_b, gravity_b, joint_pos_rel, joint_vel, ee, feet_b)


def privileged(
    base_lin_vel_b: Array,
    joint_torque: Array,
    joint_acc: Array,
    base_height: Array,
    ee_lin_vel_b: Array,
    ee_ang_vel_b: Array,
    feet_b: Array,
    kp_scale: Array,
    kd_scale: Array,
    base_mass: Array,
    friction: Array,
    foot_force_w: Array,
    payload: Array,
    payload_offset: Array,
    motor_strength: Array,
    joint_offset: Array,
    imu_tilt: Array,
    delays: Array,
    odometry_error_b: Array,
) -> Array:
    """Assemble the privileged vector (N, 107) of true values; heights, masses, factors of all are (N,).

    The end-effector's velocity is relative to the world, not to the base, and expressed in the base frame.
    """
    return _join(
        PRIVILEGED_LAYOUT,
        *(
            base_lin_vel_b,
            joint_torque,
            joint_acc,
            base_height[..., None],
            ee_lin_vel_b,
            ee_ang_vel_b,
            feet_b,
        ),
        *(kp_scale, kd_scale, base_mass[..., None], friction[..., None], foot_force_w),
        *(payload[..., None], payload_offset, motor_strength[..., None], joint_offset, imu_tilt),
        *(delays, odometry_error_b),
    )


def rows() -> list[tuple[str, ...]]:
    """List (vector, columns, size, term, unit) of all inputs, for `wbc-bench list --inputs`."""
    found = []
    for vector, layout in LAYOUTS.items():
        start = 0
        for term in layout:
            columns = f"{start}..{start + term.size - 1}" if term.size > 1 else str(start)
            found.append((vector, columns, str(term.size), term.name, term.unit))
            start += term.size
        found.append((vector, "all", str(start), "", ""))
    return found
