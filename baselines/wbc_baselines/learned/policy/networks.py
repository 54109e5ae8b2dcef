"""The policy network."""

from itertools import pairwise

from torch import Tensor, nn

from wbc_baselines.learned.policy.architecture import HIDDEN
from wbc_baselines.learned.policy.inputs import ACTIONS, COMMAND, OBSERVATION
from wbc_baselines.learned.policy.normalizer import Normalizer


class Actor(nn.Module):
    """The mean action as a function of observation, command and context. Source: paper, eq. 1."""

    def __init__(self, context_dim: int) -> None:
        super().__init__()
        sizes = (OBSERVATION + COMMAND + context_dim, *HIDDEN)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.ELU()]
        self.normalizer = Normalizer(sizes[0])
        self.mlp = nn.Sequential(*layers, nn.Linear(HIDDEN[-1], ACTIONS))

    def forward(self, x: Tensor) -> Tensor:
        """Compute mean actions (N, 14) of inputs (N, 67 + context_dim)."""
        return self.mlp(self.normalizer(x))
