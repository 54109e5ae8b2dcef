"""A policy that learns from teachers beside it, in the states that its own rollouts meet.

What is known need not be found out by reinforcement. A teacher answers in every state of a rollout and the
policy is fitted to the answers: a checkpoint that knows more (alone at first, then beside PPO, less and
less), or geometry: for the arm, while PPO teaches the legs to carry it, and for legs that stand short of the
target. Source: Ross, Gordon, Bagnell 2011, "A reduction of imitation learning and structured prediction to
no-regret online learning"; Schmitt et al. 2018, "Kickstarting deep reinforcement learning", for a teacher
that fades.
"""

import math

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import huber_loss

from wbc_baselines.learned.policy.checkpoint import Checkpoint
from wbc_baselines.learned.policy.inputs import COMMAND, OBSERVATION, OBSERVATION_LAYOUT, columns
from wbc_baselines.learned.training.arm_ik import ArmKinematics
from wbc_baselines.learned.training.dagger import DELTA
from wbc_baselines.learned.training.environment import ARRIVES, PRIVILEGED_COLUMNS
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

PARTS = 18  # of a rollout's lessons, an update each; choice, 1024 lessons a part of 768 x 24
EPOCHS = 4  # over the lessons of a rollout; choice
RATE, LEAST_RATE = 5e-4, 2e-5  # of Adam, first and last; choice
BESIDE_RATE = 3e-4  # of Adam, of lessons beside PPO; choice
BLEND = 0.3  # of the way from the policy's answer to the taught one, an iteration beside PPO; choice
SHARE = 0.25  # of a rollout's states that are lessons beside PPO; choice: geometry costs as much as physics
LEG_RATE, LEG_BLEND = 5e-5, 0.02  # the same of the legs, which PPO has to balance meanwhile; choice
REACHED = 0.05  # [m] within which the arm alone brings the hand to its target, or there is no lesson; choice
SETS_OUT = 2.0  # of the task-progress reference, below which the arm leaves its default; choice
LEGS, ARM = slice(NUM_LEG_JOINTS), slice(NUM_LEG_JOINTS, NUM_JOINTS)
GRAVITY, JOINT_POS, REFERENCE = (
    columns(OBSERVATION_LAYOUT, term) for term in ("projected gravity", "joint positions", "task-progress")
)


class Fit:
    """Supervised updates of rsl-rl's actor."""

    def __init__(self, actor: MLPModel, action_scale: Tensor) -> None:
        """action_scale (14,) [rad]."""
        self._actor, self._radians = actor, action_scale
        self.optimizer = torch.optim.Adam(actor.mlp.parameters(), RATE)

    @torch.no_grad()
    def means(self, observations: TensorDict) -> Tensor:
        """What the policy (M, 14) itself would do, to be changed."""
        return self._actor(observations).clone()

    def update(self, observations: TensorDict, action: Tensor, rate: float, epochs: int) -> float:
        """Fit the means to actions (M, 14) wanted in M states; the mean of `imitation.fit`'s loss [rad^2]."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        wanted, losses = self._radians * action, []
        for _ in range(epochs):
            for part in torch.randperm(len(wanted), device=wanted.device).chunk(PARTS):
                loss = huber_loss(self._radians * self._actor(observations[part]), wanted[part], delta=DELTA)
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                losses.append(loss.detach())
        return float(torch.stack(losses).mean())


def _some(observations: TensorDict) -> TensorDict:
    """A share (M,) of the states of a rollout (T, N)."""
    flat = observations.flatten(0, 1)
    return flat[torch.randperm(len(flat), device=flat.device)[: math.ceil(SHARE * len(flat))]]


class Teaching:
    """All joints, from a checkpoint."""

    def __init__(self, teacher: Checkpoint, actor: MLPModel, action_scale: Tensor) -> None:
        """action_scale (14,) [rad]."""
        self._teacher, self.fit = teacher.actor.to(action_scale.device), Fit(actor, action_scale)
        self._privileged = teacher.estimator.context_dim > 0

    @torch.no_grad()
    def answer(self, observations: TensorDict) -> Tensor:
        """The teacher's actions (..., 14)."""
        seen = observations["policy"]
        if self._privileged:
            seen = torch.cat([seen, observations["critic"][..., PRIVILEGED_COLUMNS]], -1)
        return self._teacher(seen)

    def update(self, observations: TensorDict, way: float) -> dict[str, float]:
        """Learn from the states of a rollout (T, N), `way` in [0, 1] of the teacher's time being over."""
        rate = LEAST_RATE + (RATE - LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * way))
        flat = observations.flatten(0, 1)
        return {"teaching": self.fit.update(flat, self.answer(flat), rate, epochs=EPOCHS)}

    def advise(self, observations: TensorDict, weight: float) -> dict[str, float]:
        """Learn beside PPO from a share of the states of a rollout (T, N), with a weight in [0, 1]."""
        flat = _some(observations)
        own = self.fit.means(flat)
        wanted = own + BLEND * weight * (self.answer(flat) - own)
        return {"advice": self.fit.update(flat, wanted, BESIDE_RATE, epochs=1)}


class ArmTeaching:
    """The joints of the arm, from its inverse kinematics; the legs stay with what the policy wants.

    The arm sets out as the task-progress reference falls, and its commands bear its weight.
    """

    def __init__(self, robot: Robot, actor: MLPModel, action_scale: Tensor) -> None:
        """action_scale (14,) [rad]."""
        self.fit = Fit(actor, action_scale)
        self._arm, self._scale = ArmKinematics(robot, action_scale.device), action_scale[ARM]
        self._default, self._kp = (
            torch.tensor(x[ARM], dtype=torch.float32, device=action_scale.device)
            for x in (robot.default_q, robot.kp)
        )

    @torch.no_grad()
    def answer(self, observations: TensorDict) -> tuple[Tensor, Tensor]:
        """Actions (M, 6) of the arm on the way to the target, and whether (M,) it gets there."""
        seen = observations["critic"]  # without noise
        q, command = self._default + seen[:, JOINT_POS][:, ARM], seen[:, OBSERVATION:][:, :COMMAND]
        there = self._arm.solve(q, command)
        miss = torch.linalg.vector_norm(self._arm.hand(there)[0] - command[:, :3], dim=-1)
        way = ((SETS_OUT - seen[:, REFERENCE]) / (SETS_OUT - ARRIVES)).clamp(0, 1)
        weight = self._arm.holding_torque(q, seen[:, GRAVITY]) / self._kp
        return (way * (there - self._default) + weight) / self._scale, miss < REACHED

    def update(self, observations: TensorDict) -> dict[str, float]:
        """Learn from a share of the states of a rollout (T, N); the root mean square miss [rad] before."""
        flat = _some(observations)
        answer, reached = self.answer(flat)
        if not reached.any():
            return {}
        flat, answer = flat[reached], answer[reached]
        wanted = self.fit.means(flat)
        miss = self._scale * (answer - wanted[:, ARM])
        wanted[:, ARM] += BLEND * (answer - wanted[:, ARM])
        self.fit.update(flat, wanted, BESIDE_RATE, epochs=1)
        return {"arm_teaching": float(miss.square().mean().sqrt())}


class PostureTeaching:
    """The legs, from a posture that reaches the target, where the robot stands still and its hand is late.

    Their commands move by a part of what the measured posture lacks: whatever torque it takes, where the
    posture is reached nothing is asked for any more. How to stay up on the way is left to PPO.
    """

    def __init__(self, actor: MLPModel, action_scale: Tensor) -> None:
        """action_scale (14,) [rad]."""
        self.fit, self._scale = Fit(actor, action_scale), action_scale[LEGS]

    def update(self, observations: TensorDict) -> dict[str, float]:
        """Learn from the states of a rollout (T, N); the root mean square lack [rad]."""
        flat = observations.flatten(0, 1)
        flat = flat[flat["lack"].any(-1)]
        if len(flat) == 0:
            return {}
        lack = flat["lack"]
        wanted = self.fit.means(flat)
        wanted[:, LEGS] += LEG_BLEND * lack / self._scale
        self.fit.update(flat, wanted, LEG_RATE, epochs=1)
        return {"posture_teaching": float(lack.square().mean().sqrt())}
