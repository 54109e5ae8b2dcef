"""Training samples of an estimator: the rollout of some of the environments."""

from collections.abc import Iterator

import torch
from torch import Tensor

from wbc_baselines.learned.policy.estimators import Batch
from wbc_baselines.learned.policy.inputs import HISTORY, HISTORY_FRAME, NEXT_OBSERVATION
from wbc_baselines.learned.training.environment import Step


class EstimatorRollout:
    """Whole sequences of some of the environments, time first."""

    def __init__(self, steps: int, ids: Tensor, state: Tensor) -> None:
        """Allocate the memory of a rollout.

        Args:
            steps: Control steps T of the rollout.
            ids: (K,) Environments that are recorded.
            state: (N, S) Recurrent states of all environments before the first step.
        """
        self.ids, self.state = ids, state[ids]
        shape = (steps, len(ids))
        self.history = torch.empty(*shape, HISTORY, HISTORY_FRAME, device=ids.device)
        self.start = torch.empty(shape, dtype=torch.bool, device=ids.device)
        self.velocity = torch.empty(*shape, 3, device=ids.device)
        self.next_observation = torch.empty(*shape, NEXT_OBSERVATION, device=ids.device)
        self.valid = torch.empty(shape, dtype=torch.bool, device=ids.device)

    def before(self, t: int, window: Tensor, start: Tensor, velocity: Tensor) -> None:
        """Record what is known before step t.

        Args:
            t: Step of the rollout.
            window: (N, HISTORY, 57) Windows of all environments.
            start: (N,) bool Whether the step is the first of an episode.
            velocity: (N, 3) [m/s] True linear velocity of the base.
        """
        self.history[t], self.start[t] = window[self.ids], start[self.ids]
        self.velocity[t] = velocity[self.ids]

    def after(self, t: int, step: Step) -> None:
        """Record the result of step t.

        Args:
            t: Step of the rollout.
            step: Result of all environments.
        """
        self.next_observation[t] = step.observations.next_observation[self.ids]
        self.valid[t] = ~step.done[self.ids]

    def batches(self, count: int) -> Iterator[Batch]:
        """Divide the rollout by environments, with whole sequences.

        Args:
            count: Number of batches.

        Yields:
            Batches of whole sequences.
        """
        for part in torch.arange(len(self.ids), device=self.ids.device).chunk(count):
            yield Batch(
                self.history[:, part],
                self.state[part],
                self.start[:, part],
                self.velocity[:, part],
                self.next_observation[:, part],
                self.valid[:, part],
            )
