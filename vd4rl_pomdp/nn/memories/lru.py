"""Linear recurrent units (Orvieto et al. 2023, arXiv 2303.06349).

    x = W row,   then in every layer   u = norm(x),   h_t = lambda h_{t-1} + gamma (B u_t),
                                       y_t = gelu(Re(C h_t) + D u_t),   x = x + y sigmoid(G y),   and s_t = norm(x)

lambda = exp(-exp(nu) + i exp(theta)) is diagonal and within the unit circle; gamma is sqrt(1 - |lambda|^2) to begin
with, so that slow units' states are no larger than fast ones'. A window takes log2(T) steps, a stream one a row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.nn.memories.base import Memory, MemoryOptions


@dataclass(frozen=True)
class LRUOptions(MemoryOptions):
    """Options of the linear recurrence."""

    lru_layers: int = 2
    """Layers of the linear recurrence."""
    lru_units: int | None = None
    """Complex units of a layer's state; None: 3/8 of hidden_dim, with as many parameters as a GRU of one layer."""
    r_min: float = 0.0
    """Least |lambda| to begin with."""
    r_max: float = 1.0
    """Greatest |lambda| to begin with."""
    max_phase: float = 2 * math.pi
    """Greatest phase of lambda to begin with, in radians."""

    limits: ClassVar[Limits] = {
        "lru_layers": (1, 64),
        "lru_units": 1,
        "r_min": (0, 1),
        "r_max": (0, 1),
        "max_phase": (0, 2 * math.pi),
    }

    def check(self) -> None:
        """Raise UserError for values that cannot work."""
        super().check()
        if self.r_min >= self.r_max:
            raise UserError(f"--r-min is {self.r_min}, --r-max {self.r_max}: choose a greater --r-max")


class LRU(Memory):
    """See the module; about as many parameters as a GRU of one layer and the same hidden_dim."""

    def __init__(self, inputs: int, options: LRUOptions) -> None:
        super().__init__()
        dim, shape = options.hidden_dim, (options.lru_layers, options.lru_units or max(1, 3 * options.hidden_dim // 8))
        # |lambda|^2 uniform: even over the ring's area. Neither 1, which would not decay, nor 0, which has no logarithm
        square = torch.empty(shape).uniform_(options.r_min**2, options.r_max**2).clamp(1e-6, 1 - 1e-6)
        self.nu = nn.Parameter((-0.5 * square.log()).log())
        self.theta = nn.Parameter(torch.empty(shape).uniform_(0, options.max_phase).clamp(min=1e-6).log())
        self.gamma = nn.Parameter(0.5 * (1 - square).log())
        """nu, theta and the logarithm of gamma: (L, N)."""
        self.read = nn.Linear(inputs, dim)
        self.layers = nn.ModuleList(_Layer(dim, shape[1]) for _ in range(shape[0]))
        self.norm = nn.LayerNorm(dim)

    def initial_state(self, batch: int) -> Tensor:
        """(L, batch, 2 N): real and imaginary parts in turns."""
        return self.nu.new_zeros(len(self.nu), batch, 2 * self.nu.shape[1])

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See `Memory`."""
        decays = torch.polar((-self.nu.exp()).exp(), self.theta.exp())
        scales = self.gamma.exp()[..., None]
        x, kept = self.read(rows), []
        before = torch.view_as_complex(state.unflatten(2, (-1, 2)))
        for layer, decay, scale, h in zip(self.layers, decays, scales, before, strict=True):
            x, after = layer(x, decay, scale, h)
            kept.append(after)
        return self.norm(x), torch.stack(kept)


class _Layer(nn.Module):
    def __init__(self, dim: int, units: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.b = nn.Linear(dim, 2 * units, bias=False)
        self.c = nn.Linear(2 * units, dim, bias=False)  # Re C and -Im C: Re(C h) is linear in h's real numbers
        self.d = nn.Parameter(torch.randn(dim))
        self.gate = nn.Linear(dim, dim)
        nn.init.normal_(self.b.weight, std=(2 * dim) ** -0.5)
        nn.init.normal_(self.c.weight, std=units**-0.5)

    def forward(self, x: Tensor, decay: Tensor, scale: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, D), and h (B, N) before -> (B, T, D), and the real numbers (B, 2 N) of h after."""
        u = self.norm(x)
        h = scan(decay, torch.view_as_complex(self.b(u).unflatten(2, (-1, 2)) * scale), before)
        h = torch.view_as_real(h).flatten(2)
        y = gelu(torch.addcmul(self.c(h), self.d, u))
        return torch.addcmul(x, y, self.gate(y).sigmoid()), h[:, -1]


def scan(decay: Tensor, inputs: Tensor, before: Tensor) -> Tensor:
    """h_t = decay h_{t-1} + inputs_t for all rows at once (Hillis and Steele 1986).

    Args:
        decay: (N,) complex, within the unit circle.
        inputs: (B, T, N) complex.
        before: (B, N) complex, h before the first row.

    Returns:
        (B, T, N). Every step doubles the rows that have been added up. Nothing is divided by a power of decay, so this
        is as stable as going row by row.
    """
    first = (inputs[:, 0] + decay * before)[:, None]
    h = torch.cat([first, inputs[:, 1:]], dim=1) if inputs.shape[1] > 1 else first
    span = 1
    while span < h.shape[1]:
        h = torch.cat([h[:, :span], h[:, span:] + decay * h[:, :-span]], dim=1)
        decay, span = decay * decay, 2 * span
    return h
