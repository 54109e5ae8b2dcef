"""Denoising diffusion over vectors: noise schedule, a compact network, deterministic sampling.

The network predicts the clean vector x0, not the noise: where a vector is nearly all noise, a small error of
the noise is a large one of the vector, and ten sampling steps do not mend it.
"""

import itertools
import math

import torch
from torch import Tensor, nn

STEPS = 100  # of the noise schedule
SAMPLING_STEPS = 10
EMBEDDING = 32  # numbers of the step's embedding


def signal(steps: int = STEPS) -> Tensor:
    """Part (steps + 1,) of a vector's variance that is signal after each step, 1 at step 0.

    Source: Nichol & Dhariwal 2021, eq. 17 (cosine schedule, s = 0.008), betas at most 0.999 as there.
    """
    s = 0.008
    part = torch.arange(steps + 1, dtype=torch.float64) / steps
    curve = torch.cos((part + s) / (1 + s) * math.pi / 2) ** 2
    kept = (curve[1:] / curve[:-1]).clamp(min=1 - 0.999)
    return torch.cat([torch.ones(1, dtype=torch.float64), kept.cumprod(0)]).float()


class Denoiser(nn.Module):
    """Residual MLP: noisy vector (B, size), step (B,), condition (B, condition) -> clean vector (B, size)."""

    def __init__(self, size: int, condition: int, hidden: int, blocks: int = 2) -> None:
        super().__init__()
        self.size = size
        self.first = nn.Linear(size + condition + EMBEDDING, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(hidden), nn.SiLU(), nn.Linear(hidden, hidden)) for _ in range(blocks)
        )
        self.last = nn.Sequential(nn.LayerNorm(hidden), nn.SiLU(), nn.Linear(hidden, size))

    def forward(self, noisy: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """The clean vector."""
        h = self.first(torch.cat([noisy, embedding(step), condition], dim=-1))
        for block in self.blocks:
            h = h + block(h)
        return self.last(h)


def embedding(step: Tensor) -> Tensor:
    """Sines and cosines (B, EMBEDDING) of a step (B,). Source: Vaswani et al. 2017, section 3.5."""
    rate = torch.exp(torch.arange(EMBEDDING // 2) * (-math.log(1e4) / (EMBEDDING // 2)))
    phase = step[:, None] * rate
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


def noised(clean: Tensor, noise: Tensor, step: Tensor) -> Tensor:
    """Vectors (B, size) after `step` (B,) steps. Source: Ho et al. 2020, eq. 4."""
    part = signal()[step][:, None]
    return part.sqrt() * clean + (1 - part).sqrt() * noise


def sample(denoise, noise: Tensor, condition: Tensor, count: int = SAMPLING_STEPS) -> Tensor:
    """Clean vectors (B, size) from noise (B, size): DDIM without randomness, `count` steps.

    `denoise(noisy, step, condition)` gives the clean vector, which is kept within [-1, 1] as the data are.
    Source: Song et al. 2021, eq. 12 with sigma = 0.
    """
    part = signal()
    x = noise
    steps = torch.linspace(STEPS, 0, count + 1).round().long()
    for now, then in itertools.pairwise(steps):
        clean = denoise(x, now.repeat(len(x)), condition).clamp(-1, 1)
        rest = (x - part[now].sqrt() * clean) / (1 - part[now]).sqrt()
        x = part[then].sqrt() * clean + (1 - part[then]).sqrt() * rest
    return x
