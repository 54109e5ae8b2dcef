"""What an estimator learns from: a rollout of some of the environments."""

from collections.abc import Iterator

import torch
from torch import Tensor

from wbc_baselines.learned.policy.estimators import Batch
from wbc_baselines.learned.policy.inputs import HISTORY, HISTORY_TERM, NEXT_OBSERVATION
from wbc_baselines.learned.training.environment import Step


class Rollout:
    """What the estimator learns from: the rollouts of some of the environments, time first."""

    def __init__(self, steps: int, ids: Tensor, state: Tensor) -> None:
        self.ids, self.state = ids, state[ids]
        shape = (steps, len(ids))
        self.history = torch.empty(*shape, HISTORY, HISTORY_TERM, device=ids.device)
        self.start = torch.empty(shape, dtype=torch.bool, device=ids.device)
        self.velocity = torch.empty(*shape, 3, device=ids.device)
        self.next_observation = torch.empty(*shape, NEXT_OBSERVATION, device=ids.device)
        self.valid = torch.empty(shape, dtype=torch.bool, device=ids.device)

    def before(self, t: int, window: Tensor, start: Tensor, velocity: Tensor) -> None:
        """What is known when step t begins."""
        self.history[t], self.start[t] = window[self.ids], start[self.ids]
        self.velocity[t] = velocity[self.ids]

    def after(self, t: int, step: Step) -> None:
        """What step t has shown."""
        self.next_observation[t] = step.seen.next_observation[self.ids]
        self.valid[t] = ~step.done[self.ids]

    def batches(self, count: int) -> Iterator[Batch]:
        """The rollout in `count` parts, environments apart and sequences whole."""
        for part in torch.arange(len(self.ids), device=self.ids.device).chunk(count):
            yield Batch(
                self.history[:, part],
                self.state[part],
                self.start[:, part],
                self.velocity[:, part],
                self.next_observation[:, part],
                self.valid[:, part],
            )
