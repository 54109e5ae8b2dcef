"""GRU only: a linear map of the newest frame replaces the Transformer."""

from torch import Tensor, nn

from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.inputs import (
    CONTEXT_MAX,
    HISTORY_FRAME,
    LATENT,
    NEXT_OBSERVATION,
    VELOCITY,
)

SIZE = VELOCITY + 2 * LATENT  # as in transformer_gru


class NewestFrame(nn.Linear):
    """Windows (N, HISTORY, 57) -> features (N, SIZE) of their last frame."""

    def __init__(self) -> None:
        super().__init__(HISTORY_FRAME, SIZE)

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input[:, -1])


class GRU(LatentEstimator):
    """Newest frame -> u (131) -> e = u + f_out(GRU(u))."""

    context_dim, state_dim, latent_dim = CONTEXT_MAX, SIZE, LATENT

    def __init__(self) -> None:
        super().__init__(NewestFrame(), Memory(SIZE), mlp(LATENT, 256, 128, NEXT_OBSERVATION))
