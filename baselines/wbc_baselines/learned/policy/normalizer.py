"""Running mean and standard deviation of an input, updated during training only."""

import torch
from torch import Tensor, nn

from wbc_baselines.learned.policy.architecture import FLOOR


class Normalizer(nn.Module):
    """(x - mean) / (std + FLOOR), per column."""

    mean: Tensor
    std: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        # samples seen so far: only training needs it, so it is not part of a checkpoint
        self.register_buffer("count", torch.zeros((), dtype=torch.float64), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return a normalized copy of (..., size)."""
        return (x - self.mean) / (self.std + FLOOR)

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Update the statistics with samples (..., size). Source: Chan, Golub, LeVeque 1979."""
        x = x.reshape(-1, self.mean.shape[0])
        count = self.count + len(x)
        weight = (len(x) / count).to(self.mean.dtype)  # of the new samples
        mean, variance = x.mean(dim=0), x.var(dim=0, correction=0)
        if self.count == 0:  # the standard deviation of before is a placeholder
            self.mean.copy_(mean)
            self.std.copy_(variance.sqrt())
        else:
            shift = mean - self.mean
            old = self.std.square()
            merged = old + weight * (variance - old) + weight * (1 - weight) * shift.square()
            self.mean += weight * shift
            self.std.copy_(merged.sqrt())
        self.count.copy_(count)
