"""GRU only: a linear map of the newest frame replaces the Transformer."""

from torch import Tensor, nn

from wbc_baselines.learned.policy.architecture import DECODER, FEATURES, SIZES
from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME, LATENT, NEXT_OBSERVATION


class NewestFrame(nn.Linear):
    """Windows (N, HISTORY, 57) -> features (N, FEATURES) of their last frame."""

    def __init__(self) -> None:
        super().__init__(HISTORY_FRAME, FEATURES)

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input[:, -1])


class GRU(LatentEstimator):
    """Newest frame -> u (131) -> e = u + f_out(GRU(u))."""

    context_dim, state_dim, latent_dim = SIZES["gru"]

    def __init__(self) -> None:
        super().__init__(NewestFrame(), Memory(FEATURES), mlp(LATENT, *DECODER, NEXT_OBSERVATION))
