"""Prediction heads on pairs of representations, MLPs, InfoNCE, and Polyak-averaged target networks."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.core import hardware

_IGNORED = -100
"""Label of anchors that cross-entropy ignores."""


class PairHead(nn.Module):
    """An MLP on (s_t, g_{t+k}, k) for many pairs at once.

    The first layer is a sum of one term per input, so it runs once per row, not once per pair.
    """

    def __init__(
        self, past_dim: int, future_dim: int, max_k: int, outputs: int, hidden: int, k_embedding: bool
    ) -> None:
        super().__init__()
        self.past = nn.Linear(past_dim, hidden)
        self.future = nn.Linear(future_dim, hidden, bias=False)
        self.k = nn.Embedding(max_k + 1, hidden) if k_embedding else None
        self.rest = nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs))

    def forward(self, past: Tensor, future: Tensor, pairs: Tensor) -> Tensor:
        """(B, T, past_dim), (B, T, future_dim) and pairs (P, 2) int64, each (t, k) -> (B, P, outputs)."""
        t, k = pairs.unbind(1)
        hidden = self.past(past).index_select(1, t) + self.future(future).index_select(1, t + k)
        if self.k is not None:
            hidden = hidden + self.k(k)
        return self.rest(hidden)


class ExactLinear(nn.Linear):
    """A linear layer with autocast disabled, for outputs whose small differences matter."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight))


def mlp(inputs: int, hidden: int, outputs: int, layers: int = 2, last: type[nn.Linear] = nn.Linear) -> nn.Sequential:
    """ReLU MLP with `layers` hidden layers and a last layer of the given class."""
    widths = [inputs] + [hidden] * layers
    modules: list[nn.Module] = []
    for a, b in pairwise(widths):
        modules += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*modules, last(hidden, outputs))


@cache
def all_pairs(rows: int, max_k: int) -> Tensor:
    """All (t, k) with 1 <= k <= max_k and t + k < rows: (P, 2) int64, ordered by k, then t; cached, do not modify."""
    pairs = [(t, k) for k in range(1, min(max_k, rows - 1) + 1) for t in range(rows - k)]
    return torch.tensor(pairs, dtype=torch.int64).view(-1, 2)


def info_nce(scores: Tensor, group: Tensor | None = None, real: Tensor | None = None) -> Tensor:
    """InfoNCE (van den Oord et al. 2018, arXiv 1807.03748): cross-entropy of identifying each anchor's positive.

    Mean over anchors and leading dimensions, in nats; log(number of candidates) for constant scores.

    Args:
        scores: (..., N, N), anchors by candidates; positives are on the diagonal.
        group: (N,) int64; candidates of the anchor's own group are not used as negatives. None: all are.
        real: (N,) bool; rows where it is False are neither anchors nor candidates. None: all count.
    """
    real = _unless_all(real)
    logits = _logits(scores, group, real)
    truth = torch.arange(scores.shape[-1], device=scores.device)
    if real is not None:
        truth = truth.masked_fill(~real, _IGNORED)
    truth = truth.expand(logits.shape[:-1])
    return F.cross_entropy(logits.flatten(0, -2), truth.reshape(-1), ignore_index=_IGNORED)


def share_found(scores: Tensor, group: Tensor | None = None, real: Tensor | None = None) -> Tensor:
    """Accuracy: share of anchors whose positive scores highest among their candidates; arguments as `info_nce`."""
    truth = torch.arange(scores.shape[-1], device=scores.device)
    real = _unless_all(real)
    found = (_logits(scores, group, real).argmax(-1) == truth).float()
    return found.mean() if real is None else (found * real).mean() / real.float().mean()


def _unless_all(real: Tensor | None) -> Tensor | None:
    """None if all are real; a mask on a GPU is kept, as reading it would synchronise."""
    return None if real is not None and hardware.in_host_memory(real) and real.all() else real


def _logits(scores: Tensor, group: Tensor | None, real: Tensor | None) -> Tensor:
    """Scores in float32, -inf for excluded candidates."""
    logits = scores.float()
    if group is None and real is None:
        return logits
    # keep the positive of anchors that are not real, too: a softmax over only -inf has NaN gradients
    own = torch.eye(scores.shape[-1], dtype=torch.bool, device=scores.device)
    if group is not None:
        logits = logits.masked_fill((group[:, None] == group[None, :]) & ~own, -torch.inf)
    if real is not None:
        logits = logits.masked_fill(~real & ~own, -torch.inf)
    return logits


@torch.no_grad()
def move_target(target: nn.Module, online: nn.Module, tau: float) -> None:
    """Polyak update: target <- (1 - tau) * target + tau * online."""
    torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), tau)
