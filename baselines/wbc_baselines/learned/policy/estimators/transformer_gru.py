"""Transformer and GRU: the paper's estimator."""

from wbc_baselines.learned.policy.estimators.latent import LatentEstimator, mlp
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.estimators.window import WindowEncoder
from wbc_baselines.learned.policy.inputs import CONTEXT_MAX, LATENT, NEXT_OBSERVATION, VELOCITY

SIZE = VELOCITY + 2 * LATENT  # 131, of the features, the recurrent state and e. Source: paper, section III-C


class TransformerGRU(LatentEstimator):
    """Window -> Transformer -> u (131) -> e = u + f_out(GRU(u))."""

    context_dim, state_dim, latent_dim = CONTEXT_MAX, SIZE, LATENT

    def __init__(self) -> None:
        super().__init__(WindowEncoder(SIZE), Memory(SIZE), mlp(LATENT, 256, 128, NEXT_OBSERVATION))
