"""The terms of the reward: gated as in the paper, and additive with the same terms and scales.

Every term is a pure function of one control step. Scales are per second, so a term is multiplied by
`scale * period`. Source: paper, section III-D, equations 6 to 12 and the table of reward terms; its silent
constants from SPIRAL-EDWIN/JC_umi-on-tron @f83d62e unless a line says otherwise.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from wbc_baselines.learned.policy.methods import Reward
from wbc_bench.robot import NUM_LEG_JOINTS

SIGMA_P2 = 0.5  # [m] sigma_p^2
SIGMA_REF2 = 0.5  # sigma_ref^2, in the unit of d_ref
SIGMA_PROG = 0.5  # [m] and [rad]
SIGMA_S2 = 0.5  # sigma_s^2
OFFSET = 0.4  # c_s. Source: paper, eq. 7
DEAD_ZONE = 0.5  # gamma of e_ref, in the unit of d_ref
GATE_SLOPE = 5.0  # k of the phase
GATE_CENTRE = 1.0  # mu of the phase, in the unit of d_ref
MIN_SEPARATION = 0.14  # [m] d_min; choice: a third less than the default 0.21 m, five sole widths

# Tolerances tau_j of the safety quantities
FOOT_X, FOOT_OUT, FOOT_IN, FOOT_MOST = 0.2, 0.2, 0.1, 8.0  # [m], [m], [m], of the sum over both feet
HEIGHT, HEIGHT_TOLERANCE = 0.80, 0.2  # [m]
ROLL, PITCH = 0.1, 0.85  # of the components of projected gravity
BASE_LIN, BASE_ANG = 0.5, 1.2  # [m/s], [rad/s]
EE_LIN, EE_ANG = 0.6, 3.14  # [m/s], [rad/s]
ARM = 9.0  # [rad] summed over the arm's joints
JOINT_SPEED = 1.0  # [rad/s] root mean square over the joints; choice: the source's value is not known

MANIPULATION_Z, LOCOMOTION_Z = 13.0, 6.0

SCALES = {  # Source: paper, table of reward terms
    "position": 6.0,
    "orientation_coarse": 6.0,
    "orientation_fine": 6.0,
    "reference": 10.0,
    "progress": 15.0,
    "safety": 2.0,
    "torque": -1e-5,
    "power": -2e-5,
    "action_variation": -2e-2,
    "foot_slip": -0.5,
    "non_flat": -1.0,
    "leg_separation": -10.0,
    "joint_limits": -1.0,
    "termination": -100.0,
}
# Choice: of one step's sum, five times what perfect tracking earns, so that a simulation about to diverge
# (seen once in several million steps of 10 ms) cannot outweigh a batch.
BOUND = 5.0


class Body(NamedTuple):
    """The properties of the robot that the reward depends on."""

    lower: Tensor  # (14,) [rad]
    upper: Tensor  # (14,) [rad]
    arm_middle: Tensor  # (6,) [rad] of the joint ranges
    nominal_feet: Tensor  # (2, 2) [m] x, y of left and right sole in the heading frame, default posture


class Signals(NamedTuple):
    """One control step of N robots. Heading frame: at the base, level, turned with the base's yaw."""

    pos_error: Tensor  # (N,) [m]
    rot_error: Tensor  # (N,) [rad]
    best_pos_error: Tensor  # (N,) [m] until the step before
    best_rot_error: Tensor  # (N,) [rad]
    d_ref: Tensor  # (N,)
    feet_h: Tensor  # (N, 2, 2) [m] x, y of left and right sole, heading frame
    base_height: Tensor  # (N,) [m]
    gravity_b: Tensor  # (N, 3)
    base_lin_vel: Tensor  # (N, 3) [m/s]
    base_ang_vel: Tensor  # (N, 3) [rad/s]
    joint_pos: Tensor  # (N, 14) [rad]
    joint_vel: Tensor  # (N, 14) [rad/s]
    joint_torque: Tensor  # (N, 14) [N m]
    ee_lin_vel: Tensor  # (N, 3) [m/s]
    ee_ang_vel: Tensor  # (N, 3) [rad/s]
    action: Tensor  # (N, 14)
    previous_action: Tensor  # (N, 14)
    foot_contact: Tensor  # (N, 2) 1 where a sole carries load, else 0
    foot_vel_w: Tensor  # (N, 2, 2) [m/s] horizontal
    foot_up_w: Tensor  # (N, 2, 2) horizontal part of the soles' normal
    terminated: Tensor  # (N,) bool: ended unsafely


class Gates(NamedTuple):
    """The factors of the task terms, each (N,) or a number."""

    manipulation: Tensor | float  # (1 - g) s~_m: position and fine orientation
    reference: Tensor | float  # g s~_l
    progress: Tensor | float  # s~_l (0.25 + 0.75 g)
    phase: Tensor | float  # g itself: how the two safety scores are mixed


# The additive reward's constants: the mean over an episode of each gate of the gated reward, so that each
# term keeps its mean weight. PHASE follows from the reference's schedule alone, over the targets of
# ablation_v1 and decays U(0.5, 1.4) (`mean_gate`; a test works it out again). The scores are the means of s~
# where their gate is open, E[(1 - g) s~_m] / E[1 - g] and E[g s~_l] / E[g], and depend on the policy.
# SCORE_M is that of a robot at rest in the witness postures of ablation_v1, the most that a policy can reach;
# SCORE_L was measured on a gated no_latent policy of 3.5 M control steps. `wbc-train gates` prints the two of
# a trained run.
PHASE = 0.1915
SCORE_M = 1.19
SCORE_L = 1.04
ADDITIVE = Gates(
    manipulation=(1 - PHASE) * SCORE_M,
    reference=PHASE * SCORE_L,
    progress=SCORE_L * (0.25 + 0.75 * PHASE),
    phase=PHASE,
)


def gate(d_ref: Tensor) -> Tensor:
    """Compute the phase g (N,), near 1 while approaching and near 0 at the target.

    Source: paper, eq. rfm_phase.
    """
    return torch.sigmoid(GATE_SLOPE * (d_ref - GATE_CENTRE))


def mean_gate(d_start: Tensor, decay: Tensor, horizon: float, steps: int = 500) -> Tensor:
    """Compute the mean of the phase g over an episode.

    Args:
        d_start: (...) Task-progress reference at the start.
        decay: (...) [1/s] Decay of the reference.
        horizon: Length of the episode [s].
        steps: Number of instants that are averaged.

    Returns:
        Means (...).
    """
    time = torch.arange(1, steps + 1) * (horizon / steps)
    return gate((d_start[..., None] - decay[..., None] * time).clamp(min=0.0)).mean(-1)


def safety_scores(signals: Signals, body: Body) -> tuple[Tensor, Tensor]:
    """Compute the safety scores s_m of manipulation and s_l of locomotion, (N,) in (0, 1].

    Source: paper, eq. 7; quantities, tolerances and weights from SPIRAL-EDWIN/JC_umi-on-tron @f83d62e.
    """
    s = signals
    off = s.feet_h - body.nominal_feet
    outward = off[..., 1] * body.nominal_feet[:, 1].sign()
    sideways = torch.where(outward > 0, outward / FOOT_OUT, -outward / FOOT_IN)
    feet = (off[..., 0].abs() / FOOT_X + sideways).sum(-1).clamp(max=FOOT_MOST)
    height = (s.base_height - HEIGHT).abs() / HEIGHT_TOLERANCE
    roll, pitch = s.gravity_b[:, 1].abs() / ROLL, s.gravity_b[:, 0].abs() / PITCH
    base = _norm(s.base_lin_vel) / BASE_LIN + _norm(s.base_ang_vel) / BASE_ANG
    speed = s.joint_vel.square().mean(-1).sqrt() / JOINT_SPEED
    arm = (s.joint_pos[:, NUM_LEG_JOINTS:] - body.arm_middle).abs().sum(-1) / ARM
    ee = _norm(s.ee_lin_vel) / EE_LIN + _norm(s.ee_ang_vel) / EE_ANG
    manipulation = feet + speed + base + 0.5 * height + 0.5 * roll + 0.25 * pitch + arm + ee
    locomotion = 0.5 * feet + pitch + roll + height
    return (
        torch.exp(manipulation / (-MANIPULATION_Z * SIGMA_S2)),
        torch.exp(locomotion / (-LOCOMOTION_Z * SIGMA_S2)),
    )


def gates_of(phase: Tensor, s_m: Tensor, s_l: Tensor) -> Gates:
    """Compute the gates of the gated reward. Source: paper, eq. 7 and 10."""
    relaxed_l = s_l + OFFSET
    return Gates((1 - phase) * (s_m + OFFSET), phase * relaxed_l, relaxed_l * (0.25 + 0.75 * phase), phase)


def rewards(
    signals: Signals, body: Body, kind: Reward, period: float
) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
    """Compute the reward of one control step.

    Args:
        signals: Quantities of N robots after the step.
        body: Properties of the robot.
        kind: Whether the task terms are gated, or weighted by the constants ADDITIVE.
        period: Control period [s].

    Returns:
        The total (N,), clipped to +-BOUND; the terms by name as they are summed, each (N,); and the gates of
        the gated reward, for the log.
    """
    s = signals
    s_m, s_l = safety_scores(s, body)
    measured = gates_of(gate(s.d_ref), s_m, s_l)
    use = measured if kind == "gated" else ADDITIVE

    tracking = torch.exp(-s.pos_error / SIGMA_P2) + torch.exp(-5 * s.pos_error / SIGMA_P2)
    fine = torch.exp(-s.pos_error / 0.5 - (s.rot_error / 0.25).square())
    e_ref = ((s.d_ref - (2 * s.pos_error + s.rot_error)).abs() - DEAD_ZONE).clamp(min=0.0)
    limits = (s.joint_pos - body.upper).clamp(min=0.0) + (body.lower - s.joint_pos).clamp(min=0.0)
    separation = (s.feet_h[:, 0, 1] - s.feet_h[:, 1, 1]).abs()
    raw = {
        "position": use.manipulation * tracking,
        "orientation_coarse": torch.exp(-(s.rot_error / 1.5).square()),
        "orientation_fine": use.manipulation * fine,
        "reference": use.reference * torch.exp(-e_ref / SIGMA_REF2),
        "progress": use.progress * progress(s),
        "safety": s_m + use.phase * (s_l - s_m),
        "torque": s.joint_torque.square().sum(-1),
        "power": (s.joint_torque * s.joint_vel).abs().sum(-1),  # [W]
        "action_variation": (s.action - s.previous_action).square().sum(-1),
        "foot_slip": (s.foot_contact * s.foot_vel_w.square().sum(-1)).sum(-1),
        "non_flat": (s.foot_contact * s.foot_up_w.square().sum(-1)).sum(-1),
        "leg_separation": (MIN_SEPARATION - separation).clamp(min=0.0),
        "joint_limits": limits.sum(-1),
        "termination": s.terminated.to(s.pos_error.dtype),
    }
    terms = {name: value * (SCALES[name] * period) for name, value in raw.items()}
    total = torch.stack(list(terms.values())).sum(0).clamp(-BOUND, BOUND)
    return total, terms, {name: torch.as_tensor(value) for name, value in measured._asdict().items()}


def progress(signals: Signals) -> Tensor:
    """Compute r_prog (N,), the decrease of the errors below their best so far. Source: paper, eq. 8."""
    s = signals
    pos_gain = (s.best_pos_error - s.pos_error).clamp(min=0.0)
    rot_gain = (s.best_rot_error - s.rot_error).clamp(min=0.0)
    best_pos, best_rot = s.best_pos_error - pos_gain, s.best_rot_error - rot_gain
    return 2 * pos_gain * torch.exp(-best_pos / SIGMA_PROG) + rot_gain * torch.exp(-best_rot / SIGMA_PROG)


def _norm(x: Tensor) -> Tensor:
    return torch.linalg.vector_norm(x, dim=-1)
