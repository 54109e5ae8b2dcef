"""A policy that learns from a teacher beside it: DAgger on the rollouts of training.

The teacher answers in every state that a rollout has met, the policy is fitted to the answers. That is far
cheaper than finding out the same by reinforcement, and any method can learn it with the context that it has.
Source: Ross, Gordon, Bagnell 2011, "A reduction of imitation learning and structured prediction to no-regret
online learning".
"""

import math

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import huber_loss

from wbc_baselines.learned.checkpoint import Checkpoint
from wbc_baselines.learned.environment import PRIVILEGED_COLUMNS
from wbc_baselines.learned.imitation import DELTA

BATCH = 1024  # lessons an update; choice, as that of `imitation.fit`
EPOCHS = 2  # over a rollout; choice
RATE, LEAST_RATE = 1e-3, 5e-5  # of Adam, first and last; choice


class Teaching:
    """Fits rsl-rl's actor to a teacher's answers."""

    def __init__(self, teacher: Checkpoint, actor: MLPModel, action_scale: Tensor) -> None:
        """action_scale (14,) [rad]."""
        self._teacher, self._actor, self._radians = teacher.actor.to(action_scale.device), actor, action_scale
        self._privileged = teacher.estimator.context_dim > 0
        self.optimizer = torch.optim.Adam(actor.mlp.parameters(), RATE)

    @torch.no_grad()
    def answer(self, observations: TensorDict) -> Tensor:
        """The teacher's actions (..., 14)."""
        seen = observations["policy"]
        if self._privileged:
            seen = torch.cat([seen, observations["critic"][..., PRIVILEGED_COLUMNS]], -1)
        return self._teacher(seen)

    def update(self, observations: TensorDict, way: float) -> dict[str, float]:
        """Learn from the states of a rollout (T, N), `way` in [0, 1] of the teacher's time being over.

        Returns the mean of the loss [rad^2], that of `imitation.fit`.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = LEAST_RATE + (RATE - LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * way))
        flat, total, count = observations.flatten(0, 1), 0.0, 0
        wanted = self._radians * self.answer(flat)
        for _ in range(EPOCHS):
            for part in torch.randperm(len(wanted), device=wanted.device).split(BATCH):
                loss = huber_loss(self._radians * self._actor(flat[part]), wanted[part], delta=DELTA)
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                total, count = total + float(loss.detach()), count + 1
        return {"teaching": total / count}
