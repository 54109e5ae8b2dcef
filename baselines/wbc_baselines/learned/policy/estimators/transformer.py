"""Transformer only: each window is encoded independently, without memory."""

from wbc_baselines.learned.policy.architecture import DECODER, FEATURES, SIZES
from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.window import WindowEncoder
from wbc_baselines.learned.policy.inputs import LATENT, NEXT_OBSERVATION


class Transformer(LatentEstimator):
    """Window -> Transformer -> e (131)."""

    context_dim, state_dim, latent_dim = SIZES["transformer"]

    def __init__(self) -> None:
        super().__init__(WindowEncoder(FEATURES), None, mlp(LATENT, *DECODER, NEXT_OBSERVATION))
