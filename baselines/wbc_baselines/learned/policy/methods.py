"""The seven methods of the study: which estimator feeds the actor, and which reward trained it."""

from typing import Literal, NamedTuple

from wbc_bench.controller import DEPLOYABLE, Signal

Reward = Literal["gated", "additive"]


class Method(NamedTuple):
    """One row of the paper's ablation."""

    estimator: str
    reward: Reward
    label: str  # as the paper's table calls it

    @property
    def estimates(self) -> bool:
        """Whether its context is estimated: not of the method without one, nor of the oracle."""
        return self.estimator not in ("none", "oracle")

    @property
    def signals(self) -> frozenset[Signal]:
        """What the policy reads in an evaluation; the oracle alone reads more than the paper's policy may."""
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
