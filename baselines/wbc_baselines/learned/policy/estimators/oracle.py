"""The upper bound: the context is the true privileged vector, and nothing is estimated."""

from wbc_baselines.learned.policy.estimators.base import Estimator
from wbc_baselines.learned.policy.inputs import PRIVILEGED


class Oracle(Estimator):
    """The method whose context is the privileged vector, assembled by environment or controller."""

    def __init__(self, context_dim: int = PRIVILEGED) -> None:
        super().__init__()
        self.context_dim = context_dim
