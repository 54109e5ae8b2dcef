"""Transformer and GRU: the paper's estimator."""

from wbc_baselines.learned.policy.architecture import DECODER, FEATURES, SIZES
from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.estimators.window import WindowEncoder
from wbc_baselines.learned.policy.inputs import LATENT, NEXT_OBSERVATION


class TransformerGRU(LatentEstimator):
    """Window -> Transformer -> u (131) -> e = u + f_out(GRU(u))."""

    context_dim, state_dim, latent_dim = SIZES["transformer_gru"]

    def __init__(self) -> None:
        super().__init__(WindowEncoder(FEATURES), Memory(FEATURES), mlp(LATENT, *DECODER, NEXT_OBSERVATION))
