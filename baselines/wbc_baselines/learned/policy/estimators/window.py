"""The Transformer over one window of observations, of which only the last token is used."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from wbc_baselines.learned.policy.architecture import (
    FEED_FORWARD,
    HEAD,
    HEADS,
    LAYERS,
    MODEL,
    sinusoids,
)
from wbc_baselines.learned.policy.inputs import HISTORY, HISTORY_FRAME


class Layer(nn.Module):
    """Self-attention and a feed-forward part, each added to its input and normalised after.

    Source: Vaswani et al. 2017, section 3.1. Written out because `nn.TransformerEncoderLayer` computes every
    token, and of the last layer one is enough.
    """

    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(MODEL, 3 * MODEL)
        self.out = nn.Linear(MODEL, MODEL)
        self.norm1 = nn.LayerNorm(MODEL)
        self.norm2 = nn.LayerNorm(MODEL)
        self.widen = nn.Linear(MODEL, FEED_FORWARD)
        self.narrow = nn.Linear(FEED_FORWARD, MODEL)

    def forward(self, x: Tensor, last_only: bool = False) -> Tensor:
        """Tokens (N, T, MODEL) -> tokens of the same shape, or the last one (N, 1, MODEL)."""
        attended = self._attend_last(x) if last_only else self._attend(x)
        x = self.norm1((x[:, -1:] if last_only else x) + self.out(attended))
        return self.norm2(x + self.narrow(self.widen(x).relu_()))

    def _attend(self, x: Tensor) -> Tensor:
        """Attention of every token to all tokens, (N, T, MODEL)."""
        query, key, value = (
            part.unflatten(-1, (HEADS, HEAD)).transpose(1, 2) for part in self.qkv(x).chunk(3, -1)
        )
        return functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)

    def _attend_last(self, x: Tensor) -> Tensor:
        """Attention of the last token to all tokens, (N, 1, MODEL).

        Keys and values of the tokens are not formed: q . (K x) = (K^T q) . x, and the mean of V x is V times
        the mean of x. That is a sixth of the work. The bias of the keys moves all scores alike and drops out.
        """
        weights = self.qkv.weight.unflatten(0, (3, HEADS, HEAD))[
            1:
        ]  # keys and values, (2, HEADS, HEAD, MODEL)
        query = functional.linear(x[:, -1], self.qkv.weight[:MODEL], self.qkv.bias[:MODEL])
        query = query.unflatten(-1, (HEADS, HEAD)).transpose(0, 1)  # (HEADS, N, HEAD)
        asked = (query @ weights[0]).transpose(0, 1) / math.sqrt(HEAD)  # (N, HEADS, MODEL)
        share = (asked @ x.transpose(1, 2)).softmax(dim=-1)  # (N, HEADS, T)
        gathered = (share @ x).transpose(0, 1) @ weights[1].transpose(1, 2)  # (HEADS, N, HEAD)
        return (gathered.transpose(0, 1).flatten(1) + self.qkv.bias[2 * MODEL :])[:, None]


class WindowEncoder(nn.Module):
    """Windows (N, HISTORY, 57) -> features (N, size). Source: paper, eq. transformer_history_encoder."""

    positions: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.embed = nn.Linear(HISTORY_FRAME, MODEL)
        self.register_buffer("positions", torch.from_numpy(sinusoids(HISTORY, MODEL)), persistent=False)
        self.layers = nn.ModuleList(Layer() for _ in range(LAYERS))
        self.read_out = nn.Linear(MODEL, size)

    def forward(self, window: Tensor) -> Tensor:
        x = self.embed(window) + self.positions
        for layer in self.layers[:-1]:
            x = layer(x)
        return self.read_out(self.layers[-1](x, last_only=True)[:, 0])
