"""Untrained policies of every method, for the tests of checkpoints, controllers and export."""

from pathlib import Path

import torch

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.estimators import Batch, Estimator, make_estimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_bench.episodes.protocol import find_protocol


def networks(method: str, seed: int = 0) -> tuple[Actor, Estimator]:
    """Random weights and normalisers; actions small enough that the robot stands for a while."""
    torch.manual_seed(seed)
    estimator = make_estimator(METHODS[method].estimator)
    actor = Actor(estimator.context_dim)
    with torch.no_grad():
        for module in (actor, estimator):
            for name, buffer in module.named_buffers():
                if name.endswith(("mean", "std")):
                    buffer.uniform_(0.5, 1.5)
        actor.state_dict()["mlp.6.weight"].mul_(0.1)
    return actor, estimator


def write(folder: Path, method: str, seed: int = 0) -> Path:
    """A checkpoint METHOD@SEED in a folder."""
    path = folder / f"{method}@{seed}.safetensors"
    card = new_card(method, seed, 1000, 1.5, find_protocol("smoke_v1")[0])
    checkpoint.save(path, *networks(method, seed), card)
    return path


def batch(estimator: Estimator, steps: int = 12, count: int = 5, seed: int = 0) -> tuple[Batch, torch.Tensor]:
    """A random rollout with episodes that start inside it, and noise for its latents."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw)

    start = torch.rand(steps, count, generator=draw) < 0.2
    valid = ~start.roll(-1, dims=0)
    rollout = Batch(
        history=normal(steps, count, 10, 57),
        state=normal(count, estimator.state_dim),
        start=start,
        velocity=normal(steps, count, 3),
        next_observation=normal(steps, count, 49),
        valid=valid,
    )
    return rollout, normal(steps, count, estimator.latent_dim)
