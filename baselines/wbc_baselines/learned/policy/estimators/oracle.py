"""The upper bound: the context is what the simulation knows, and nothing is estimated."""

from wbc_baselines.learned.policy.estimators.base import Estimator
from wbc_baselines.learned.policy.inputs import PRIVILEGED


class Oracle(Estimator):
    """Its context is the privileged vector, which the environment or the controller puts together."""

    context_dim = PRIVILEGED
