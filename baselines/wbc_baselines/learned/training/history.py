"""The window of an estimator during training; an evaluation carries it inside of the policy."""

import torch
from torch import Tensor

from wbc_baselines.learned.policy.inputs import HISTORY


class History:
    """The last HISTORY frames of N robots, oldest first.

    An episode starts with its first frame repeated (choice: the paper does not specify it).
    """

    def __init__(self, first: Tensor) -> None:
        """Fill the windows with the first frames (N, 57)."""
        self.window = first[:, None].repeat(1, HISTORY, 1)  # (N, HISTORY, 57)

    def reset(self, ids: Tensor, frame: Tensor) -> None:
        """Restart the robots `ids` (K,) with their first frames (K, 57)."""
        self.window[ids] = frame[:, None]

    def push(self, frame: Tensor, fresh: Tensor | None = None) -> None:
        """Drop the oldest frame and append a new one, without changing the previous window in place.

        Args:
            frame: (N, 57) Newest frames.
            fresh: (N,) bool Robots whose episode starts with this frame.
        """
        self.window = torch.cat([self.window[:, 1:], frame[:, None]], dim=1)
        if fresh is not None:
            self.window = torch.where(fresh[:, None, None], frame[:, None], self.window)
