"""Initialization of a policy with the weights of a checkpoint."""

import torch

from wbc_baselines.learned.policy.inputs import COMMAND, OBSERVATION
from wbc_baselines.learned.policy.networks import Actor

INPUTS = OBSERVATION + COMMAND


def warm_start(actor: torch.nn.Module, init: Actor, context: int, count: int) -> None:
    """Copy weights and normalizer statistics of a checkpoint into rsl-rl's actor.

    Args:
        actor: Actor of rsl-rl that is to be initialized.
        init: Policy of the checkpoint.
        context: Number of context columns that both policies share. Further columns of the checkpoint are
            held at their mean, further columns of the actor begin with weights of zero.
        count: Number of observations that the copied statistics count for in the running averages.
    """
    weights, mine = init.mlp.state_dict(), actor.mlp.state_dict()  # type: ignore[union-attr]
    columns = INPUTS + context
    first = torch.zeros_like(mine["0.weight"])
    first[:, :columns] = weights["0.weight"][:, :columns]
    actor.mlp.load_state_dict(weights | {"0.weight": first})  # type: ignore[union-attr]
    normalizer, mean, std = actor.obs_normalizer, init.normalizer.mean, init.normalizer.std
    normalizer._mean[0, :columns] = mean[:columns]  # type: ignore[index]
    normalizer._var[0, :columns] = std[:columns].square()  # type: ignore[index]
    normalizer._std[0, :columns] = std[:columns]  # type: ignore[index]
    normalizer.count.fill_(count)  # type: ignore[union-attr]
