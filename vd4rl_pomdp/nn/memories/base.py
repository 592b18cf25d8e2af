"""Base class of memories, the GRU, and the integrator, a lower bound for memories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.options import Limits, Options


@dataclass(frozen=True)
class MemoryOptions(Options):
    """Options of every memory."""

    hidden_dim: int = 256
    """Dimension of the memory's output s_t."""
    m: int | None = None
    """Rows before t that s_t is computed from; None: the method's default (8 for fj and fj+a, else all)."""

    limits: ClassVar[Limits] = {"hidden_dim": 1, "m": 0}


class Memory(nn.Module):
    """A causal sequence model: output j depends only on rows 0..j and the initial state."""

    reach: int | None = None
    """Number of most recent rows that an output depends on, its own included; None: all."""
    first_only: bool = False
    """Whether it reads the observation's features in row 0 only, and just the actions in later rows."""
    features: int
    """Number of leading inputs of a row that are observation features; set by `make_memory`."""

    def initial_state(self, batch: int) -> Tensor:
        """State before an episode's first row: (L, batch, W) zeros, with the dtype of the weights."""
        raise NotImplementedError

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Rows (B, T, I), T > 0, and state (L, B, W) -> outputs (B, T, hidden_dim) and the state after the last row."""
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


class Integrator(GRU):
    """A lower bound for memories: a GRU that sees the first observation, the actions since then, and the time.

        h_t = GRU(h_{t-1}, [e(o_0), a_{t-1}, log(1 + t)]),   s_t = h_t

    Row 0 is the first row it reads: an episode's first or, with a history window or a random history, the first of
    those. No later pixel is read, so s_t holds only what follows from the first observation and the actions. Its state
    consists of the GRU's state, the number of rows read, and e(o_0).
    """

    first_only = True

    def __init__(self, inputs: int, options: GRUOptions) -> None:
        super().__init__(inputs + 1, options)  # + 1 for the time
        self.features = inputs

    def initial_state(self, batch: int) -> Tensor:
        """(gru_layers, batch, hidden_dim + 1 + F)."""
        return next(self.parameters()).new_zeros(self.num_layers, batch, self.hidden_size + 1 + self.features)

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        hidden, count, first = state.split([self.hidden_size, 1, self.features], dim=2)
        t = count[0] + torch.arange(rows.shape[1], device=rows.device)  # (B, T)
        first = torch.where(count[0] > 0, first[0], rows[:, 0, : self.features])
        inputs = first[:, None].expand(-1, rows.shape[1], -1), rows[..., self.features :], t.log1p()[..., None]
        out, hidden = super().forward(torch.cat(inputs, dim=2), hidden.contiguous())
        after = torch.cat([t[:, -1:] + 1, first], dim=1).expand(len(hidden), -1, -1)
        return out, torch.cat([hidden, after], dim=2)
