"""Linear recurrent units (Orvieto et al. 2023, arXiv 2303.06349).

    x = W row,   then in every layer   u = norm(x),   h_t = lambda h_{t-1} + gamma (B u_t),
                                       y_t = gelu(Re(C h_t) + D u_t),   x = x + y sigmoid(G y),   and s_t = norm(x)

lambda = exp(-exp(nu) + i exp(theta)) is diagonal and inside the unit circle. gamma is initialised to
sqrt(1 - |lambda|^2), so that slow and fast units have states of equal scale. A window takes a scan of log2(T) steps.
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
    """Complex units per layer; None: 3/8 of hidden_dim, which matches a one-layer GRU in parameters."""
    r_min: float = 0.0
    """Smallest |lambda| at initialisation."""
    r_max: float = 1.0
    """Largest |lambda| at initialisation."""
    max_phase: float = 2 * math.pi
    """Largest phase of lambda at initialisation, in radians."""

    limits: ClassVar[Limits] = {
        "lru_layers": (1, 64),
        "lru_units": 1,
        "r_min": (0, 1),
        "r_max": (0, 1),
        "max_phase": (0, 2 * math.pi),
    }

    def check(self) -> None:
        super().check()
        if self.r_min >= self.r_max:
            raise UserError(f"--r-min is {self.r_min}, --r-max {self.r_max}: choose a greater --r-max")


class LRU(Memory):
    """Stacked LRU layers; see the module. About as many parameters as a one-layer GRU of the same hidden_dim."""

    def __init__(self, inputs: int, options: LRUOptions) -> None:
        super().__init__()
        dim, shape = options.hidden_dim, (options.lru_layers, options.lru_units or max(1, 3 * options.hidden_dim // 8))
        # |lambda|^2 uniform makes lambda uniform over the ring's area; clamped, as 1 never decays and log(0) is -inf
        square = torch.empty(shape).uniform_(options.r_min**2, options.r_max**2).clamp(1e-6, 1 - 1e-6)
        self.nu = nn.Parameter((-0.5 * square.log()).log())
        self.theta = nn.Parameter(torch.empty(shape).uniform_(0, options.max_phase).clamp(min=1e-6).log())
        self.gamma = nn.Parameter(0.5 * (1 - square).log())
        """nu, theta and the logarithm of gamma: (L, N)."""
        self.read = nn.Linear(inputs, dim)
        self.layers = nn.ModuleList(_Layer(dim, shape[1]) for _ in range(shape[0]))
        self.norm = nn.LayerNorm(dim)

    def initial_state(self, batch: int) -> Tensor:
        """(L, batch, 2 N), real and imaginary parts interleaved."""
        return self.nu.new_zeros(len(self.nu), batch, 2 * self.nu.shape[1])

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        decays = torch.polar((-self.nu.exp()).exp(), self.theta.exp())
        scales = self.gamma.exp()[..., None]
        x, states = self.read(rows), []
        before = torch.view_as_complex(state.unflatten(2, (-1, 2)))
        for layer, decay, scale, h in zip(self.layers, decays, scales, before, strict=True):
            x, after = layer(x, decay, scale, h)
            states.append(after)
        return self.norm(x), torch.stack(states)


class _Layer(nn.Module):
    def __init__(self, dim: int, units: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.b = nn.Linear(dim, 2 * units, bias=False)
        self.c = nn.Linear(2 * units, dim, bias=False)  # Re C and -Im C: Re(C h) is linear in (Re h, Im h)
        self.d = nn.Parameter(torch.randn(dim))
        self.gate = nn.Linear(dim, dim)
        nn.init.normal_(self.b.weight, std=(2 * dim) ** -0.5)
        nn.init.normal_(self.c.weight, std=units**-0.5)

    def forward(self, x: Tensor, decay: Tensor, scale: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, D) and complex h (B, N) before row 0 -> (B, T, D) and the final h as (B, 2 N) reals."""
        u = self.norm(x)
        h = scan(decay, torch.view_as_complex(self.b(u).unflatten(2, (-1, 2)) * scale), before)
        h = torch.view_as_real(h).flatten(2)
        y = gelu(torch.addcmul(self.c(h), self.d, u))
        return torch.addcmul(x, y, self.gate(y).sigmoid()), h[:, -1]


def scan(decay: Tensor, inputs: Tensor, before: Tensor) -> Tensor:
    """Parallel scan of h_t = decay h_{t-1} + inputs_t (Hillis and Steele 1986): (B, T, N) complex.

    From decay (N,), inputs (B, T, N) and h before the first row (B, N). Each of log2(T) steps doubles the span that is
    summed. It never divides by powers of decay, so it is as stable as the sequential recurrence.
    """
    first = (inputs[:, 0] + decay * before)[:, None]
    h = torch.cat([first, inputs[:, 1:]], dim=1) if inputs.shape[1] > 1 else first
    span = 1
    while span < h.shape[1]:
        h = torch.cat([h[:, :span], h[:, span:] + decay * h[:, :-span]], dim=1)
        decay, span = decay * decay, 2 * span
    return h
