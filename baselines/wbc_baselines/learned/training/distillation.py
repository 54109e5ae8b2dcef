"""Imitation losses that are computed on the states of the policy's own rollouts.

Behavior that is known in advance need not be discovered by reinforcement learning. A teacher gives an action
for every state of a rollout, and the policy is fitted to it: a checkpoint with more information (alone at
first, then beside PPO with a decreasing weight), the inverse kinematics of the arm, and leg postures that
reach the target.

Source: Ross, Gordon, Bagnell 2011, "A reduction of imitation learning and structured prediction to no-regret
online learning"; Schmitt et al. 2018, "Kickstarting deep reinforcement learning", for the decreasing weight.
"""

import math

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import huber_loss

from wbc_baselines.learned.policy.checkpoint import Checkpoint
from wbc_baselines.learned.policy.inputs import (
    COMMAND,
    OBSERVATION,
    OBSERVATION_LAYOUT,
    PRIVILEGED_LAYOUT,
    columns,
)
from wbc_baselines.learned.training.arm_ik import ArmKinematics
from wbc_baselines.learned.training.dagger import HUBER_DELTA
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS
from wbc_baselines.learned.training.precision import fast_products
from wbc_baselines.learned.training.state_view import ARRIVAL_REFERENCE
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

MINI_BATCHES = 18  # updates per pass; choice: 1024 states per update for a rollout of 768 x 24
EPOCHS = 4  # passes of the distillation over each rollout; choice
INITIAL_LEARNING_RATE, FINAL_LEARNING_RATE = 5e-4, 2e-5  # of the distillation; choice
AUXILIARY_LEARNING_RATE = 3e-4  # of the losses beside PPO; choice
TARGET_STEP = 0.3  # fraction of the way from the policy's to the teacher's action, per iteration; choice
SAMPLE_FRACTION = 0.25  # of a rollout's states in a loss beside PPO; choice: inverse kinematics is expensive
# The same for the legs, far smaller because PPO has to keep the balance meanwhile; choice.
LEG_LEARNING_RATE, LEG_TARGET_STEP = 5e-5, 0.02
REACHED = 0.05  # [m] largest position error of an inverse-kinematics solution that is imitated; choice
DEPARTURE_REFERENCE = 2.0  # task-progress reference below which the arm leaves its default; choice
LEGS, ARM = slice(NUM_LEG_JOINTS), slice(NUM_LEG_JOINTS, NUM_JOINTS)
GRAVITY, JOINT_POS, REFERENCE = (
    columns(OBSERVATION_LAYOUT, term) for term in ("projected gravity", "joint positions", "task-progress")
)

GAINS, PAYLOAD, PLACE, ENCODERS = (
    columns(PRIVILEGED_LAYOUT, term)
    for term in ("kp factors", "payload", "place of the payload", "errors of the encoders")
)


class SupervisedUpdate:
    """Supervised updates of the mean of rsl-rl's actor."""

    def __init__(self, actor: MLPModel, action_scale: Tensor) -> None:
        """Create an optimizer of its own for the actor's network.

        Args:
            actor: The policy to update.
            action_scale: (14,) [rad] Joint angle per unit of action.
        """
        self._actor, self._radians = actor, action_scale
        self.optimizer = torch.optim.Adam(actor.mlp.parameters(), INITIAL_LEARNING_RATE)

    @torch.no_grad()
    def means(self, observations: TensorDict) -> Tensor:
        """Return a copy of the policy's mean actions (M, 14), which the caller may modify."""
        return self._actor(observations).clone()

    def update(self, observations: TensorDict, action: Tensor, learning_rate: float, epochs: int) -> float:
        """Fit the policy's mean to target actions.

        Args:
            observations: Observation groups of M states.
            action: (M, 14) Target actions.
            learning_rate: Learning rate of Adam.
            epochs: Passes over the states.

        Returns:
            The mean Huber loss [rad^2] over all updates, as in `dagger.fit`.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        wanted, losses = self._radians * action, []
        with fast_products(wanted.device):
            for _ in range(epochs):
                for part in torch.randperm(len(wanted), device=wanted.device).chunk(MINI_BATCHES):
                    answer = self._radians * self._actor(observations[part])
                    loss = huber_loss(answer, wanted[part], delta=HUBER_DELTA)
                    self.optimizer.zero_grad()
                    loss.backward()
                    self.optimizer.step()
                    losses.append(loss.detach())
        return float(torch.stack(losses).mean())


def sample_states(observations: TensorDict) -> TensorDict:
    """Draw SAMPLE_FRACTION of the states of a rollout (T, N) without replacement, as (M,)."""
    flat = observations.flatten(0, 1)
    return flat[torch.randperm(len(flat), device=flat.device)[: math.ceil(SAMPLE_FRACTION * len(flat))]]


class Distillation:
    """Imitation of a teacher checkpoint with all joints."""

    def __init__(self, teacher: Checkpoint, actor: MLPModel, action_scale: Tensor) -> None:
        """Take a teacher and the policy that imitates it.

        Args:
            teacher: Checkpoint of a method without an estimator.
            actor: The policy to update.
            action_scale: (14,) [rad] Joint angle per unit of action.
        """
        self._teacher = teacher.actor.to(action_scale.device)
        self.supervised = SupervisedUpdate(actor, action_scale)
        self._privileged = teacher.estimator.context_dim  # first columns of the privileged vector

    @torch.no_grad()
    def actions(self, observations: TensorDict) -> Tensor:
        """Return the teacher's actions (..., 14) in the given states (...)."""
        seen = observations["policy"]
        if self._privileged:
            seen = torch.cat(
                [seen, observations["critic"][..., PRIVILEGED_COLUMNS][..., : self._privileged]], -1
            )
        return self._teacher(seen)

    def update(self, observations: TensorDict, progress: float) -> dict[str, float]:
        """Fit the policy to the teacher alone, in all states of a rollout.

        Args:
            observations: Observation groups of a rollout (T, N).
            progress: Completed fraction in [0, 1] of the distillation, which anneals the learning rate.

        Returns:
            The loss by name.
        """
        annealed = 0.5 * (1 + math.cos(math.pi * progress))
        rate = FINAL_LEARNING_RATE + (INITIAL_LEARNING_RATE - FINAL_LEARNING_RATE) * annealed
        flat = observations.flatten(0, 1)
        return {"distillation": self.supervised.update(flat, self.actions(flat), rate, epochs=EPOCHS)}

    def kickstart(self, observations: TensorDict, weight: float) -> dict[str, float]:
        """Move the policy toward the teacher beside PPO, in a sample of the states of a rollout.

        Args:
            observations: Observation groups of a rollout (T, N).
            weight: Weight of the teacher's actions in [0, 1].

        Returns:
            The loss by name.
        """
        flat = sample_states(observations)
        own = self.supervised.means(flat)
        wanted = own + TARGET_STEP * weight * (self.actions(flat) - own)
        return {"kickstart": self.supervised.update(flat, wanted, AUXILIARY_LEARNING_RATE, epochs=1)}


class ArmIKLoss:
    """Imitation of the arm's inverse kinematics by the arm joints; the leg actions stay as they are.

    The target moves from the default posture to the inverse-kinematics solution while the task-progress
    reference falls. It contains the deflection that holds the weight of arm and payload with the gains of the
    episode, and the errors of its encoders: a kilogram in the hand of the paper's arm turns its wrist by more
    than 10 degrees.
    """

    def __init__(self, robot: Robot, actor: MLPModel, action_scale: Tensor) -> None:
        """Take the robot's arm and the policy that imitates.

        Args:
            robot: Robot with the arm.
            actor: The policy to update.
            action_scale: (14,) [rad] Joint angle per unit of action.
        """
        self.supervised = SupervisedUpdate(actor, action_scale)
        self._arm, self._scale = ArmKinematics(robot, action_scale.device), action_scale[ARM]
        self._default, self._kp = (
            torch.tensor(x[ARM], dtype=torch.float32, device=action_scale.device)
            for x in (robot.default_q, robot.kp)
        )

    @torch.no_grad()
    def actions(self, observations: TensorDict) -> tuple[Tensor, Tensor]:
        """Return the arm's target actions (M, 6), and whether (M,) the arm reaches the target."""
        seen = observations["critic"]  # without noise
        hidden = seen[:, PRIVILEGED_COLUMNS]
        q, command = self._default + seen[:, JOINT_POS][:, ARM], seen[:, OBSERVATION:][:, :COMMAND]
        solution = self._arm.solve(q, command)
        error = torch.linalg.vector_norm(self._arm.hand(solution)[0] - command[:, :3], dim=-1)  # [m]
        progress = (DEPARTURE_REFERENCE - seen[:, REFERENCE]) / (DEPARTURE_REFERENCE - ARRIVAL_REFERENCE)
        torque = self._arm.holding_torque(q, seen[:, GRAVITY], hidden[:, PAYLOAD], hidden[:, PLACE])
        deflection = torque / (self._kp * hidden[:, GAINS][:, ARM])  # [rad]
        wanted = progress.clamp(0, 1) * (solution - self._default) + deflection + hidden[:, ENCODERS][:, ARM]
        return wanted / self._scale, error < REACHED

    def update(self, observations: TensorDict, pace: float = 1.0) -> dict[str, float]:
        """Move the arm's actions toward the targets, in a sample of the states of a rollout (T, N).

        Args:
            observations: Observation groups of a rollout (T, N).
            pace: Factor on the learning rate, see `TrainConfig.pace`.

        Returns:
            The root mean square difference [rad] before the update, by name; empty if no target is in reach.
        """
        flat = sample_states(observations)
        target, reached = self.actions(flat)
        if not reached.any():
            return {}
        flat, target = flat[reached], target[reached]
        wanted = self.supervised.means(flat)
        difference = self._scale * (target - wanted[:, ARM])
        wanted[:, ARM] += TARGET_STEP * (target - wanted[:, ARM])
        self.supervised.update(flat, wanted, pace * AUXILIARY_LEARNING_RATE, epochs=1)
        return {"arm_ik": float(difference.square().mean().sqrt())}


class PostureLoss:
    """Imitation of a leg posture that reaches the target, where a robot stands still and its hand is late.

    The leg actions move by a fraction of the difference between the measured and the wanted posture, whatever
    torque this takes; where the posture is reached, nothing is changed any more. Balance is left to PPO.
    """

    def __init__(self, actor: MLPModel, action_scale: Tensor) -> None:
        """Take the policy that imitates.

        Args:
            actor: The policy to update.
            action_scale: (14,) [rad] Joint angle per unit of action.
        """
        self.supervised, self._scale = SupervisedUpdate(actor, action_scale), action_scale[LEGS]

    def update(self, observations: TensorDict, pace: float = 1.0) -> dict[str, float]:
        """Move the leg actions toward the postures, wherever `leg_posture_error` is not zero.

        Args:
            observations: Observation groups of a rollout (T, N).
            pace: Factor on the learning rate, see `TrainConfig.pace`.

        Returns:
            The root mean square posture error [rad] by name; empty where there is none.
        """
        flat = observations.flatten(0, 1)
        flat = flat[flat["leg_posture_error"].any(-1)]
        if len(flat) == 0:
            return {}
        error = flat["leg_posture_error"]
        wanted = self.supervised.means(flat)
        wanted[:, LEGS] += LEG_TARGET_STEP * error / self._scale
        self.supervised.update(flat, wanted, pace * LEG_LEARNING_RATE, epochs=1)
        return {"posture": float(error.square().mean().sqrt())}
