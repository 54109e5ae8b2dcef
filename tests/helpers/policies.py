"""Untrained policies of every method, for the tests of checkpoints, controllers and export."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.estimators import Batch, Estimator, make_estimator
from wbc_baselines.learned.policy.inputs import HISTORY
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_baselines.learned.policy.numpy_policy import NumpyPolicy
from wbc_baselines.learned.policy.policy import Policy
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


def numpy_policy(method: str, actor: Actor, estimator: Estimator) -> NumpyPolicy:
    """The policy that an evaluation computes, of the same weights."""
    tensors = {}
    for part, module in (("actor", actor), ("estimator", estimator)):
        tensors |= {f"{part}.{name}": value.numpy() for name, value in module.state_dict().items()}
    return NumpyPolicy(METHODS[method].estimator, tensors)


class TorchEngine:
    """A policy computed by torch, with window and recurrent state as tensors."""

    def __init__(self, actor: Actor, estimator: Estimator) -> None:
        self.policy = Policy(actor, estimator).eval()
        self.flow = self.policy.flow

    def begin(self, frame: NDArray[np.float32]) -> dict[str, torch.Tensor]:
        found = {}
        if "window" in self.flow.inputs:
            found["window"] = torch.from_numpy(frame)[:, None].repeat(1, HISTORY, 1)
        if "state" in self.flow.inputs:
            found["state"] = torch.zeros(len(frame), *self.flow.inputs["state"])
        return found

    def __call__(
        self, values: Mapping[str, NDArray[np.float32]], carried: dict[str, torch.Tensor]
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, torch.Tensor]]:
        with torch.inference_mode():
            found = self.policy({name: torch.from_numpy(value) for name, value in values.items()} | carried)
        carried = {name: found.pop(name) for name in carried}
        return {name: value.numpy() for name, value in found.items()}, carried


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
