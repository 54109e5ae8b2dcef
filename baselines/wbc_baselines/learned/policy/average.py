"""The mean of the weights of several checkpoints of one training.

Small rollouts say little of where a policy that is good already should go: PPO's steps of a fixed KL
divergence are mostly random ones there, and each policy along the way is worse than their mean. Source:
Izmailov et al. 2018, "Averaging Weights Leads to Wider Optima and Better Generalization"; Wortsman et al.
2022 (model soups).
"""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import CheckpointError
from wbc_bench import provenance


def average(paths: Sequence[Path], out: Path) -> None:
    """Write a checkpoint whose weights and normalisers are the mean of those of others.

    The means are taken in float64. The card is that of the checkpoint with the most control steps, with those
    of its training, and names all of them with their SHA-256.

    Args:
        paths: PATH.safetensors of two checkpoints or more, of one method and seed, for the same robot. One
            that is given twice counts twice.
        out: PATH.safetensors to write.

    Raises:
        CheckpointError: Fewer than two, one that cannot be read, or one of another method, seed, robot,
            protocol or size.
        UnknownNameError: There is no such method.
    """
    if len(paths) < 2:
        raise CheckpointError(f"average of {len(paths)} checkpoints, valid: 2 or more")
    found = [checkpoint.load(path) for path in paths]
    first = found[0].card
    for path, one in zip(paths, found, strict=True):
        for field in ("method", "seed", "robot_digest", "protocol_digest", "dimensions"):
            mine, others = getattr(one.card, field), getattr(first, field)
            if mine != others:
                raise CheckpointError(
                    f"average: '{path}' has the {field.replace('_', ' ')} {mine}, valid: that of "
                    f"'{paths[0]}', {others}"
                )
    with torch.no_grad():
        for parts in zip(*((one.actor, one.estimator) for one in found), strict=True):
            states = [part.state_dict() for part in parts]
            for name, value in states[0].items():
                values = [state[name].numpy().astype(np.float64) for state in states]
                value.copy_(torch.from_numpy(np.mean(values, axis=0)))
    newest = max((one.card for one in found), key=lambda card: card.samples)
    commit, dirty = provenance.commit()
    card = msgspec.structs.replace(
        newest,
        git_commit=commit,
        git_dirty=dirty,
        mean_of=tuple(f"{one.card.samples} {one.card.sha256}" for one in found),
    )
    checkpoint.save(out, found[0].actor, found[0].estimator, card)
