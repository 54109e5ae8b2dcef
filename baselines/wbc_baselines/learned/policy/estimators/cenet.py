"""CENet, the context estimator of DreamWaQ: a beta-VAE over a short window."""

from torch import Tensor, nn

from wbc_baselines.learned.policy.architecture import (
    CENET_DECODER,
    CENET_ENCODER,
    CENET_LATENT,
    CENET_WINDOW,
    SIZES,
)
from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME, NEXT_OBSERVATION, VELOCITY


class NewestFrames(nn.Sequential):
    """Windows (N, HISTORY, 57) -> e (N, 3 + 2 CENET_LATENT) of their last CENET_WINDOW frames."""

    def __init__(self) -> None:
        super().__init__(*mlp(CENET_WINDOW * HISTORY_FRAME, *CENET_ENCODER, VELOCITY + 2 * CENET_LATENT))

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input[:, -CENET_WINDOW:].flatten(1))


class CENet(LatentEstimator):
    """Encoder 128-64, decoder 64-128 from velocity and latent, squared errors. Source: DreamWaQ."""

    context_dim, state_dim, latent_dim = SIZES["cenet"]
    error = staticmethod(lambda a, b: (a - b).square())
    decode_velocity = True

    def __init__(self) -> None:
        super().__init__(NewestFrames(), None, mlp(SIZES["cenet"].context, *CENET_DECODER, NEXT_OBSERVATION))
