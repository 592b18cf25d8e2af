"""Random numbers for an objective whose position is part of its state_dict, so that a resumed run repeats no draw."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.streams import stream_seed
from vd4rl_pomdp.corruptions.keys import next_keys


class Draws(nn.Module):
    """The random stream `name` of a run with seed `seed`; its position is a buffer."""

    def __init__(self, seed: int, *name: str) -> None:
        super().__init__()
        self.seed = stream_seed(seed, *name)
        self.register_buffer("position", torch.zeros((), dtype=torch.int64))
        self.position: Tensor

    def keys(self, *shape: int) -> Tensor:
        """Fresh int64 keys."""
        return next_keys(self.seed, self.position, shape)

    def integers(self, high: int | Tensor, *shape: int) -> Tensor:
        """Uniform int64 in [0, high); `high` may be a 0-d int64 tensor, which CUDA graphs need if it varies."""
        return ((self.keys(*shape) >> 33 & 0x3FFFFFFF) * high) >> 30

    def uniform(self, *shape: int) -> Tensor:
        """Uniform float32 in (0, 1)."""
        # float32 holds 22 bits plus one half exactly, so neither 0 nor 1 is ever drawn.
        return ((self.keys(*shape) >> 33 & 0x3FFFFF).float() + 0.5) / 0x400000
