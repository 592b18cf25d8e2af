"""Gated recurrent units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.nn.memories.base import Memory, MemoryOptions


@dataclass(frozen=True)
class GRUOptions(MemoryOptions):
    """Options of the GRU."""

    gru_layers: int = 1
    """Layers of the GRU."""

    limits: ClassVar[Limits] = {"gru_layers": (1, 64)}


class GRU(nn.GRU, Memory):
    """Gated recurrent units (Cho et al. 2014, arXiv 1406.1078), batch first."""

    def __init__(self, inputs: int, options: GRUOptions) -> None:
        super().__init__(inputs, options.hidden_dim, options.gru_layers, batch_first=True)

    def initial_state(self, batch: int) -> Tensor:
        """(gru_layers, batch, hidden_dim)."""
        return next(self.parameters()).new_zeros(self.num_layers, batch, self.hidden_size)
