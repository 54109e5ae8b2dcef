"""Transformer only: each window is encoded independently, without memory."""

from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.window import WindowEncoder
from wbc_baselines.learned.policy.inputs import CONTEXT_MAX, LATENT, NEXT_OBSERVATION, VELOCITY


class Transformer(LatentEstimator):
    """Window -> Transformer -> e (131)."""

    context_dim, latent_dim = CONTEXT_MAX, LATENT

    def __init__(self) -> None:
        super().__init__(WindowEncoder(VELOCITY + 2 * LATENT), None, mlp(LATENT, 256, 128, NEXT_OBSERVATION))
