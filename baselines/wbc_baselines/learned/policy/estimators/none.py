"""No context: the actor receives the current observation and the command only."""

from torch import Tensor

from wbc_baselines.learned.policy.estimators.base import Estimator


class NoContext(Estimator):
    """The method without a latent."""

    def step(self, history: Tensor, state: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """An empty context (N, 0)."""
        return history[:, -1, :0], state
