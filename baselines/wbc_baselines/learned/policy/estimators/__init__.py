"""The context estimators, one small module each."""

from wbc_baselines.learned.policy.estimators.base import Batch, Estimator
from wbc_baselines.learned.policy.estimators.cenet import CENet
from wbc_baselines.learned.policy.estimators.gru import GRU
from wbc_baselines.learned.policy.estimators.none import NoContext
from wbc_baselines.learned.policy.estimators.oracle import Oracle
from wbc_baselines.learned.policy.estimators.transformer import Transformer
from wbc_baselines.learned.policy.estimators.transformer_gru import TransformerGRU
from wbc_bench.errors import UnknownNameError

__all__ = ["ESTIMATORS", "Batch", "Estimator", "Oracle", "make_estimator"]

ESTIMATORS: dict[str, type[Estimator]] = {
    "none": NoContext,
    "cenet": CENet,
    "gru": GRU,
    "transformer": Transformer,
    "transformer_gru": TransformerGRU,
    "oracle": Oracle,
}


def make_estimator(name: str) -> Estimator:
    """Create an estimator with random weights from torch's global generator.

    Args:
        name: Name of an estimator.

    Returns:
        The estimator.

    Raises:
        UnknownNameError: There is no such estimator.
    """
    if name not in ESTIMATORS:
        raise UnknownNameError("estimator", name, ESTIMATORS, "make_estimator")
    return ESTIMATORS[name]()
