"""A floor for memories: gated recurrent units that see the first observation, the actions since and the time.

    h_t = GRU(h_{t-1}, [e(o_0), a_{t-1}, log(1 + t)]),   s_t = h_t

Row 0 is the first that it reads: an episode's or, under a history window or a random history, that one's. No pixel of a
later row is read, so what s_t tells is what the first observation and adding up actions tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vd4rl_pomdp.nn.memories.base import GRU, GRUOptions


class Integrator(GRU):
    """See the module. Its state is that of the GRU, how many rows it has read, and e(o_0)."""

    first_only = True

    def __init__(self, inputs: int, options: GRUOptions) -> None:
        super().__init__(inputs + 1, options)  # and the time
        self.features = inputs

    def initial_state(self, batch: int) -> Tensor:
        """(gru_layers, batch, hidden_dim + 1 + F)."""
        return next(self.parameters()).new_zeros(self.num_layers, batch, self.hidden_size + 1 + self.features)

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """See `Memory`."""
        hidden, count, first = state.split([self.hidden_size, 1, self.features], dim=2)
        t = count[0] + torch.arange(rows.shape[1], device=rows.device)  # (B, T)
        first = torch.where(count[0] > 0, first[0], rows[:, 0, : self.features])
        told = first[:, None].expand(-1, rows.shape[1], -1), rows[..., self.features :], t.log1p()[..., None]
        out, hidden = super().forward(torch.cat(told, dim=2), hidden.contiguous())
        after = torch.cat([t[:, -1:] + 1, first], dim=1).expand(len(hidden), -1, -1)
        return out, torch.cat([hidden, after], dim=2)
