"""A causal transformer with sliding-window attention.

    x = W row,   then in every layer   x = x + Attention(norm(x)),   x = x + MLP(norm(x)),   and s_t = norm(x)

Pre-norm, without dropout. Scores are q_i k_j / sqrt(d) + r_{i-j}, with a learned bias per head and distance (Raffel et
al. 2020, arXiv 1910.10683, without its buckets), initialised as ALiBi (Press et al. 2022, arXiv 2108.12409). Positions
are relative only, so stepping row by row gives the same outputs as a whole window, without a row counter.

The state is a KV cache of the last window - 1 rows, with a flag for each row that says whether it exists.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, scaled_dot_product_attention, silu

from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.nn.memories.base import Memory, MemoryOptions

_NEVER = -1e30
"""Added to masked scores: the softmax weight is exactly zero, and the sum of two of them is still finite."""


@dataclass(frozen=True)
class TransformerOptions(MemoryOptions):
    """Options of the transformer."""

    transformer_layers: int = 2
    """Layers of the transformer."""
    transformer_heads: int = 4
    """Attention heads per layer."""
    attention_window: int = 32
    """Rows that a layer attends to, the current one included; with L layers a state sees L (window - 1) + 1 rows."""

    limits: ClassVar[Limits] = {"transformer_layers": (1, 64), "transformer_heads": 1, "attention_window": 2}


class Transformer(Memory):
    """See the module. About as many parameters as a one-layer GRU of the same hidden_dim."""

    def __init__(self, inputs: int, options: TransformerOptions) -> None:
        super().__init__()
        layers, heads, self.window = options.transformer_layers, options.transformer_heads, options.attention_window
        self.reach = layers * (self.window - 1) + 1
        width = heads * max(1, options.hidden_dim // (4 * heads))
        self._sizes = [self.window - 1, *[(self.window - 1) * 2 * width] * layers]
        self.read = nn.Linear(inputs, options.hidden_dim)
        self.layers = nn.ModuleList(_Layer(options.hidden_dim, heads, width) for _ in range(layers))
        slopes = 2.0 ** (-8 * torch.arange(1, heads + 1) / heads)
        self.bias = nn.Parameter((-slopes[:, None] * torch.arange(self.window).flip(0)).repeat(layers, 1, 1))
        """(L, heads, window): bias per distance, from window - 1 down to 0."""
        self.norm = nn.LayerNorm(options.hidden_dim)

    def initial_state(self, batch: int) -> Tensor:
        """(1, batch, (window - 1) * (1 + L * 2 * A)): flags, then each layer's keys and values, all zero."""
        return self.bias.new_zeros(1, batch, sum(self._sizes))

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        batch, count, _ = rows.shape
        there, *pasts = state[0].split(self._sizes, dim=1)
        there = torch.cat([there, there.new_ones(batch, count)], dim=1)
        # queries in blocks of at most `window` rows: the cost per row does not grow with the episode's length
        size = min(count, self.window)
        masks = self._biases(size)[:, None] + ((_blocks(there, size, self.window) - 1) * -_NEVER)[:, None, None]
        x, state_parts = self.read(rows), [there[:, count:]]
        for layer, past, mask in zip(self.layers, pasts, masks.unbind(), strict=True):
            x, seen = layer(x, past.view(batch, self.window - 1, -1), mask, size)
            state_parts.append(seen[:, count:].flatten(1))
        return self.norm(x), torch.cat(state_parts, dim=1)[None]

    def _biases(self, size: int) -> Tensor:
        """(L, heads, size, window - 1 + size): biases between a block's queries and the keys it may read."""
        # Toeplitz: each row is the previous one shifted by one, so repeat one padded row and reshape
        row = pad(self.bias, (0, size), value=_NEVER)
        written = row[:, :, None].expand(-1, -1, size, -1).flatten(2)
        return written[..., : size * (self.window - 1 + size)].unflatten(2, (size, -1))


class _Layer(nn.Module):
    def __init__(self, dim: int, heads: int, width: int) -> None:
        super().__init__()
        self.heads, self.width = heads, width
        units = max(1, 3 * dim // 4)
        self.norm, self.mlp_norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.qkv, self.out = nn.Linear(dim, 3 * self.width, bias=False), nn.Linear(self.width, dim)
        self.mlp_in, self.mlp_out = nn.Linear(dim, units), nn.Linear(units, dim)

    def forward(self, x: Tensor, past: Tensor, mask: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """(B, T, D), cached keys and values (B, window - 1, 2 A) -> (B, T, D), all of them (B, window - 1 + T, 2 A)."""
        batch, count, _ = x.shape
        q, new = self.qkv(self.norm(x)).split([self.width, 2 * self.width], dim=2)
        seen = torch.cat([past, new], dim=1)
        q = _blocks(q, size, 1).unflatten(2, (self.heads, -1)).transpose(1, 2)
        k, v = _blocks(seen, size, past.shape[1] + 1).unflatten(2, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        read = scaled_dot_product_attention(q, k, v, attn_mask=mask)
        read = read.transpose(1, 2).reshape(batch, -1, self.width)[:, :count]
        x = x + self.out(read)
        return x + self.mlp_out(silu(self.mlp_in(self.mlp_norm(x)))), seen


def _blocks(x: Tensor, size: int, window: int) -> Tensor:
    """Overlapping blocks of (B, window - 1 + T, ...), zero-padded: (B * blocks, window - 1 + size, ...)."""
    rows = x.shape[1] - window + 1
    if rows == size:
        return x
    count = -(-rows // size)
    x = pad(x, (*[0, 0] * (x.dim() - 2), 0, count * size - rows))
    return torch.stack([x[:, size * b : size * (b + 1) + window - 1] for b in range(count)], dim=1).flatten(0, 1)
