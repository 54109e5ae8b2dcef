"""Statistics of training's episodes, accumulated on the device and read once per iteration."""

import numpy as np
import torch
from torch import Tensor

from wbc_baselines.learned.training.state_view import DerivedState, Episode
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.outcomes import STRATA

COLUMNS = ("count", "success", "fell", "diverged", "length", "return", "pos_error", "rot_error", "timed_out")


class EpisodeLog:
    """Sums of reward terms and gates over steps, and of outcomes over ended episodes."""

    def __init__(self, protocol: EvalProtocol, device: torch.device) -> None:
        """Begin with nothing counted.

        Args:
            protocol: Protocol whose rule of success applies.
            device: Device of the environment.
        """
        self._protocol, self._device = protocol, device
        self.clear()

    def clear(self) -> None:
        """Forget everything that has been counted."""
        self._sums: Tensor | float = 0.0  # of the means named in `_named`
        self._named: list[str] = []
        self._steps = 0
        self._ended = torch.zeros(len(STRATA), len(COLUMNS), dtype=torch.float64, device=self._device)

    def add(
        self,
        terms: dict[str, Tensor],
        gates: dict[str, Tensor],
        derived: DerivedState,
        episode: Episode,
        done: Tensor,
        time_out: Tensor,
        diverged: Tensor,
    ) -> None:
        """Count one control step of N environments.

        Args:
            terms: (N,) Reward terms by name.
            gates: (N,) Gates of the gated reward by name.
            derived: Derived state after the step.
            episode: Episodes, the step included.
            done: (N,) bool Whether the episode ended.
            time_out: (N,) bool Whether it ended at the horizon.
            diverged: (N,) bool Whether its simulation diverged.
        """
        self._steps += 1
        named = {f"reward/{k}": v for k, v in terms.items()} | {f"gate/{k}": v for k, v in gates.items()}
        self._named = list(named)
        self._sums = self._sums + torch.stack(list(named.values())).mean(-1)
        held = time_out & (episode.steps_in_tolerance >= self._protocol.window_steps)
        fell = done & ~time_out & ~diverged
        nothing = torch.zeros_like(derived.pos_error)
        columns = [
            *(torch.ones_like(derived.pos_error), held, fell, diverged),
            *(episode.step, episode.episode_return),
            *(torch.where(time_out, error, nothing) for error in (derived.pos_error, derived.rot_error)),
            time_out,
        ]
        rows = torch.stack([torch.where(done, column, 0).double() for column in columns], -1)
        self._ended.index_add_(0, episode.stratum, rows)

    def means(self) -> dict[str, float]:
        """Compute the means since `clear`.

        Returns:
            Reward terms per step, gates, and outcomes per ended episode, over all strata and for each.
            Success and falls are fractions of ended episodes; errors are those at the end of episodes that
            reached the horizon. NaN where no episode ended.
        """
        sums = torch.as_tensor(self._sums).tolist() if self._named else []
        found = {name: value / self._steps for name, value in zip(self._named, sums, strict=True)}
        ended = self._ended.cpu().numpy()
        for name, row in [("", ended.sum(0)), *((f"_{s}", ended[k]) for k, s in enumerate(STRATA))]:
            episodes, success, fell, diverged, length, total, pos, rot, lasted = row
            share = 1 / episodes if episodes else np.nan
            found |= {
                f"episode{name}/count": episodes,
                f"episode{name}/success": success * share,
                f"episode{name}/falls": fell * share,
                f"episode{name}/diverged": diverged,
                f"episode{name}/seconds": length * share * self._protocol.control_period,
                f"episode{name}/return": total * share,
                f"episode{name}/pos_error": pos / lasted if lasted else np.nan,
                f"episode{name}/rot_error": rot / lasted if lasted else np.nan,
            }
        return found
