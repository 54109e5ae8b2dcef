"""The seven methods of the study: which estimator feeds the actor, and which reward trained it."""

from typing import Literal, NamedTuple

from wbc_bench.controller import DEPLOYABLE, Signal

Reward = Literal["gated", "additive"]


class Method(NamedTuple):
    """One row of the paper's ablation."""

    estimator: str
    reward: Reward
    label: str  # name in the paper's table

    @property
    def estimates(self) -> bool:
        """Whether the context is estimated, which excludes the oracle and the method without a context."""
        return self.estimator not in ("none", "oracle")

    @property
    def signals(self) -> frozenset[Signal]:
        """Signals that the policy reads in an evaluation; only the oracle reads privileged ones."""
        privileged: frozenset[Signal] = frozenset({"base_pose", "privileged"})
        return DEPLOYABLE | privileged if self.estimator == "oracle" else DEPLOYABLE


METHODS: dict[str, Method] = {  # Source: paper, Table III
    "no_latent": Method("none", "gated", "No latent"),
    "cenet": Method("cenet", "gated", "DreamWaQ/CENet"),
    "gru": Method("gru", "gated", "GRU only"),
    "transformer": Method("transformer", "gated", "Transformer only"),
    "transformer_gru": Method("transformer_gru", "gated", "Transformer + GRU"),
    "transformer_gru_additive": Method("transformer_gru", "additive", "Matched additive"),
    "oracle": Method("oracle", "gated", "Privileged oracle"),
}
