"""No context: the actor sees the present observation and the command alone."""

from torch import Tensor

from wbc_baselines.learned.policy.estimators.base import Estimator


class NoContext(Estimator):
    """The method without a latent."""

    def step(self, history: Tensor, state: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """An empty context (N, 0)."""
        return history[:, -1, :0], state
