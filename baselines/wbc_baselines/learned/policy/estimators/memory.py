"""Memory across windows: a GRU whose output is added to its input features."""

import torch
from torch import Tensor, nn


class Memory(nn.Module):
    """e = u + f_out(r), (r, m) = GRU(u, m). Source: paper, eq. recurrent_context and context_residual."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.cell = nn.GRUCell(size, size)
        self.out = nn.Linear(size, size)

    def forward(self, u: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Compute e (N, F) and the next state (N, F) of features u (N, F)."""
        state = self.cell(u, state)  # of a GRU the output is the state
        return u + self.out(state), state

    def unroll(self, u: Tensor, state: Tensor, start: Tensor) -> Tensor:
        """Compute e (T, N, F) of features u (T, N, F); the state (N, F) is zeroed where start (T, N)."""
        keep = (~start).to(u.dtype)[..., None]
        states = []
        for features, kept in zip(u.unbind(), keep.unbind(), strict=True):
            state = self.cell(features, state * kept)
            states.append(state)
        return u + self.out(torch.stack(states))
