"""A policy begins with the weights of another one."""

import torch

from wbc_baselines.learned.policy.inputs import COMMAND, OBSERVATION
from wbc_baselines.learned.policy.networks import Actor

INPUTS = OBSERVATION + COMMAND


def begin_with(actor: torch.nn.Module, start: Actor, context: int, samples: int) -> None:
    """Give rsl-rl's actor the weights of a start.

    context: how many columns of context they share. Others of the start stay at their mean, others of the
        actor begin without effect.
    samples: how many observations the start's normaliser counts for, before it follows training's own.
    """
    weights, mine = start.mlp.state_dict(), actor.mlp.state_dict()  # type: ignore[union-attr]
    columns = INPUTS + context
    first = torch.zeros_like(mine["0.weight"])
    first[:, :columns] = weights["0.weight"][:, :columns]
    actor.mlp.load_state_dict(weights | {"0.weight": first})  # type: ignore[union-attr]
    normalizer, mean, std = actor.obs_normalizer, start.normalizer.mean, start.normalizer.std
    normalizer._mean[0, :columns] = mean[:columns]  # type: ignore[index]
    normalizer._var[0, :columns] = std[:columns].square()  # type: ignore[index]
    normalizer._std[0, :columns] = std[:columns]  # type: ignore[index]
    normalizer.count.fill_(samples)  # type: ignore[union-attr]
