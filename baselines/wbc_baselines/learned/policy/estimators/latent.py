"""The common part of estimators with a latent: its distribution, the losses, single steps and rollouts."""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

from wbc_baselines.learned.policy.estimators.base import Batch, Estimator
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME, VELOCITY
from wbc_baselines.learned.policy.normalizer import Normalizer

VARIANCE_FLOOR = 1e-4  # Source: paper, eq. estimated_context
KL_WEIGHT = 0.1  # beta. Source: paper, section III-C


def split(e: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Split e (..., 3 + 2 L) into velocity (..., 3) [m/s], and mean and variance (..., L) of the latent.

    Source: paper, eq. context_partition and eq. estimated_context.
    """
    latent = (e.shape[-1] - VELOCITY) // 2
    velocity, mean, log_variance = e.split([VELOCITY, latent, latent], dim=-1)
    return velocity, mean, log_variance.exp() + VARIANCE_FLOOR


def kl_to_standard(mean: Tensor, variance: Tensor) -> Tensor:
    """Compute the KL divergence (..., L) of N(mean, variance) from N(0, 1).

    Source: Kingma and Welling 2014, app. B.
    """
    return 0.5 * (variance + mean.square() - 1.0 - variance.log())


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Average values (T, N, F) over features and over the valid samples (T, N); 0 if there are none."""
    kept = torch.where(valid[..., None], values, 0.0).sum()
    return kept / (valid.sum().clamp(min=1) * values.shape[-1])


def mlp(*sizes: int) -> nn.Sequential:
    """Create linear layers of these sizes with ELU in between."""
    layers: list[nn.Module] = []
    for k, (inputs, outputs) in enumerate(pairwise(sizes)):
        layers += [nn.ELU()] * (k > 0) + [nn.Linear(inputs, outputs)]
    return nn.Sequential(*layers)


class LatentEstimator(Estimator):
    """Encoder -> optional memory -> e = (velocity, mean, log variance) -> context (velocity, latent).

    The encoder receives normalised windows. Losses are means over features, as in the lineage of the paper
    (SPIRAL-EDWIN/JC_umi-on-tron @f83d62e, ppo_ios.py): the velocity, the next observation and the KL
    divergence then have equal weights whatever their number of columns. Only the prediction is masked by
    `valid`, because velocity and latent of an episode's last step are valid targets.
    """

    trainable = True
    error: Callable[[Tensor, Tensor], Tensor] = staticmethod(lambda a, b: (a - b).abs())  # L1
    decode_velocity = False  # whether the decoder also sees the velocity

    def __init__(self, encoder: nn.Module, memory: Memory | None, decoder: nn.Module) -> None:
        super().__init__()
        self.normalizer = Normalizer(HISTORY_FRAME)
        self.encoder, self.memory, self.decoder = encoder, memory, decoder

    def step(self, history: Tensor, state: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Estimator.step`. Source: paper, eq. transformer_history_encoder to eq. estimated_context."""
        e = self.encoder(self.normalizer(history))
        if self.memory is not None:
            e, state = self.memory(e, state)
        velocity, mean, variance = split(e)
        latent = mean if noise is None else mean + variance.sqrt() * noise
        return torch.cat([velocity, latent], dim=-1), state

    def encode(self, batch: Batch) -> Tensor:
        """Compute e (T, N, 3 + 2 L) of a whole rollout, equal to what `step` computes step by step."""
        steps, count = batch.start.shape
        e = self.encoder(self.normalizer(batch.history.flatten(0, 1))).unflatten(0, (steps, count))
        return e if self.memory is None else self.memory.unroll(e, batch.state, batch.start)

    def losses(self, batch: Batch, noise: Tensor) -> dict[str, Tensor]:
        """Compute `velocity`, `prediction`, `kl` and their weighted `total`.

        Source: paper, eq. estimator_loss.
        """
        velocity, mean, variance = split(self.encode(batch))
        latent = mean + variance.sqrt() * noise
        code = torch.cat([velocity, latent], dim=-1) if self.decode_velocity else latent
        losses = {
            "velocity": self.error(velocity, batch.velocity).mean(),
            "prediction": masked_mean(self.error(self.decoder(code), batch.next_observation), batch.valid),
            "kl": kl_to_standard(mean, variance).mean(),
        }
        return losses | {"total": losses["velocity"] + losses["prediction"] + KL_WEIGHT * losses["kl"]}

    def observe(self, history: Tensor) -> None:
        """Update the input normalizer with the newest frames of windows (..., HISTORY, 57)."""
        self.normalizer.update(history[..., -1, :])
