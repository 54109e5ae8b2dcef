"""What every context estimator offers, and the rollout it learns from."""

from typing import ClassVar, NamedTuple

from torch import Tensor, nn


class Batch(NamedTuple):
    """A rollout of N robots over T control steps, time first; nothing in it carries a gradient."""

    history: Tensor  # (T, N, HISTORY, 57)
    state: Tensor  # (N, S) before the first step
    start: Tensor  # (T, N) bool: step t is the first of an episode; the state is zeroed before it
    velocity: Tensor  # (T, N, 3) [m/s] true base linear velocity, base frame
    next_observation: Tensor  # (T, N, 49) without noise
    valid: Tensor  # (T, N) bool: the next observation is of the same episode


class Estimator(nn.Module):
    """A map from the window of observations, and maybe a recurrent state, to the actor's context.

    `context_dim` columns of context, `state_dim` of recurrent state, `latent_dim` of noise for a sampled
    latent; `trainable` says whether `losses` exists.
    """

    context_dim: ClassVar[int] = 0
    state_dim: ClassVar[int] = 0
    latent_dim: ClassVar[int] = 0
    trainable: ClassVar[bool] = False

    def step(self, history: Tensor, state: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Context (N, context_dim) and next state (N, S) of windows (N, HISTORY, 57) and states (N, S).

        noise (N, latent_dim), standard normal, samples the latent; without it the latent is its mean.
        """
        raise NotImplementedError

    def losses(self, batch: Batch, noise: Tensor) -> dict[str, Tensor]:
        """Scalars by name; `total` is what is minimised. noise (T, N, latent_dim), standard normal."""
        raise NotImplementedError

    def observe(self, history: Tensor) -> None:
        """Take the newest terms of windows (..., HISTORY, 57) into the input normaliser, in training."""
