"""What algorithms with critics share: two independent Q functions."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vd4rl_pomdp.nn.heads import ExactLinear, mlp


class TwinCritic(nn.Module):
    """Two independent Q functions: (B, D), (B, A) -> two (B,)."""

    def __init__(self, dim: int, action_dim: int, hidden: int) -> None:
        super().__init__()
        self.first = mlp(dim + action_dim, hidden, 1, last=ExactLinear)
        self.second = mlp(dim + action_dim, hidden, 1, last=ExactLinear)

    def forward(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Both values."""
        both = torch.cat([z, action], dim=-1)
        return self.first(both)[:, 0], self.second(both)[:, 0]
