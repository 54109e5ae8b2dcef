"""The Transformer over one window of observations, of which only the last token is read out."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from wbc_baselines.learned.inputs import HISTORY, HISTORY_TERM

# Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e; no dropout
MODEL, LAYERS, HEADS, FEED_FORWARD = 128, 2, 8, 512


def sinusoids(length: int, size: int) -> Tensor:
    """Positional encodings (length, size). Source: Vaswani et al. 2017, section 3.5."""
    angle = torch.arange(length)[:, None] * torch.exp(torch.arange(0, size, 2) * (-math.log(1e4) / size))
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(1)


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
        if last_only:
            key, value = functional.linear(x, self.qkv.weight[MODEL:], self.qkv.bias[MODEL:]).chunk(2, -1)
            x = x[:, -1:]
            query = functional.linear(x, self.qkv.weight[:MODEL], self.qkv.bias[:MODEL])
            attended = _attend_once(query, key, value)
        else:
            query, key, value = (_heads(part).transpose(1, 2) for part in self.qkv(x).chunk(3, -1))
            attended = functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        x = self.norm1(x + self.out(attended))
        return self.norm2(x + self.narrow(self.widen(x).relu_()))


def _heads(x: Tensor) -> Tensor:
    """(N, T, HEADS, MODEL / HEADS) of (N, T, MODEL)."""
    return x.unflatten(-1, (HEADS, MODEL // HEADS))


def _attend_once(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """What one query (N, 1, MODEL) gathers from T tokens, (N, 1, MODEL).

    Products and sums instead of `scaled_dot_product_attention`: twice as fast for a single query.
    """
    scores = _heads(query * key).sum(-1) / math.sqrt(MODEL // HEADS)  # (N, T, HEADS)
    return (scores.softmax(dim=1)[..., None] * _heads(value)).sum(1, keepdim=True).flatten(2)


class WindowEncoder(nn.Module):
    """Windows (N, HISTORY, 57) -> features (N, size). Source: paper, eq. transformer_history_encoder."""

    positions: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.embed = nn.Linear(HISTORY_TERM, MODEL)
        self.register_buffer("positions", sinusoids(HISTORY, MODEL), persistent=False)
        self.layers = nn.ModuleList(Layer() for _ in range(LAYERS))
        self.read_out = nn.Linear(MODEL, size)

    def forward(self, window: Tensor) -> Tensor:
        x = self.embed(window) + self.positions
        for layer in self.layers[:-1]:
            x = layer(x)
        return self.read_out(self.layers[-1](x, last_only=True)[:, 0])
