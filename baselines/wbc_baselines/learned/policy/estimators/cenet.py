"""CENet, the context estimator of DreamWaQ: a beta-VAE over a short window."""

from torch import Tensor, nn

from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME, NEXT_OBSERVATION, VELOCITY

WINDOW, LATENT = 5, 16  # Source: Nahrendra et al. 2023 (DreamWaQ), section III-B


class NewestFrames(nn.Sequential):
    """Windows (N, HISTORY, 57) -> e (N, 3 + 2 LATENT) of their last WINDOW frames."""

    def __init__(self) -> None:
        super().__init__(*mlp(WINDOW * HISTORY_FRAME, 128, 64, VELOCITY + 2 * LATENT))

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input[:, -WINDOW:].flatten(1))


class CENet(LatentEstimator):
    """Encoder 128-64, decoder 64-128 from velocity and latent, squared errors. Source: DreamWaQ."""

    context_dim, latent_dim = VELOCITY + LATENT, LATENT
    error = staticmethod(lambda a, b: (a - b).square())
    decode_velocity = True

    def __init__(self) -> None:
        super().__init__(NewestFrames(), None, mlp(VELOCITY + LATENT, 64, 128, NEXT_OBSERVATION))
