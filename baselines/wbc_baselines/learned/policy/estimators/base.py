"""The interface of context estimators, and the rollout that they are trained on."""

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
    """A function from the window of observations, and possibly a recurrent state, to the actor's context.

    `context_dim`, `state_dim` and `latent_dim` are the columns of the context, of the recurrent state and of
    the noise for a sampled latent; `trainable` states whether `losses` exists.
    """

    context_dim: int = 0
    state_dim: ClassVar[int] = 0
    latent_dim: ClassVar[int] = 0
    trainable: ClassVar[bool] = False

    def step(self, history: Tensor, state: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute the context of one control step.

        Args:
            history: (N, HISTORY, 57) Windows.
            state: (N, S) Recurrent states.
            noise: (N, latent_dim) Standard normal noise that samples the latent; None for its mean.

        Returns:
            Context (N, context_dim) and next recurrent state (N, S).
        """
        raise NotImplementedError

    def losses(self, batch: Batch, noise: Tensor) -> dict[str, Tensor]:
        """Compute the losses of a rollout.

        Args:
            batch: Whole sequences.
            noise: (T, N, latent_dim) Standard normal noise that samples the latent.

        Returns:
            Scalars by name, of which `total` is minimized.
        """
        raise NotImplementedError

    def observe(self, history: Tensor) -> None:
        """Update the input normalizer with the newest frames of windows (..., HISTORY, 57)."""
