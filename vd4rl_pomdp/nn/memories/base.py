"""What a memory is, and gated recurrent units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from vd4rl_pomdp.core.options import Limits, Options


@dataclass(frozen=True)
class MemoryOptions(Options):
    """Options of every memory."""

    hidden_dim: int = 256
    """Width of the memory's output s_t."""
    m: int | None = None
    """Rows before t that a state is computed from; None: what the method has (fj and fj+a 8, the others all)."""

    limits: ClassVar[Limits] = {"hidden_dim": 1, "m": 0}


class Memory(nn.Module):
    """A recurrence. What it puts out at row j depends on rows 0..j and on the state before row 0 alone."""

    reach: int | None = None
    """Rows that an output depends on, its own among them; None: all."""
    first_only: bool = False
    """Whether of row 0 alone it reads the observation's features; of later rows then the actions."""
    features: int
    """Numbers at the beginning of a row that are the observation's features; `make_memory` tells."""

    def initial_state(self, batch: int) -> Tensor:
        """State before an episode's first row: (L, batch, W) zeros in the precision of its weights."""
        raise NotImplementedError

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, I) rows, T > 0, and an (L, B, W) state -> (B, T, hidden_dim), and the state after the last row."""
        raise NotImplementedError


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
