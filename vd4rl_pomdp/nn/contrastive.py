"""InfoNCE (van den Oord et al. 2018, arXiv 1807.03748) over a batch of windows."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def info_nce(scores: Tensor, group: Tensor | None = None) -> Tensor:
    """Cross-entropy of telling each anchor's own candidate from the others.

    Args:
        scores: (..., N, N), anchors by candidates; the diagonal holds the true pairs.
        group: (N,) int64; the other candidates of an anchor's own group are no negatives. None: all others are.

    Returns:
        Mean over anchors and leading dimensions, in nats. It is log(candidates) when scores tell nothing.
    """
    logits = _logits(scores, group)
    truth = torch.arange(scores.shape[-1], device=scores.device).expand(logits.shape[:-1])
    return F.cross_entropy(logits.flatten(0, -2), truth.reshape(-1))


def share_found(scores: Tensor, group: Tensor | None = None) -> Tensor:
    """Share of anchors whose own candidate scores highest among those that `info_nce` counts; the same arguments."""
    truth = torch.arange(scores.shape[-1], device=scores.device)
    return (_logits(scores, group).argmax(-1) == truth).float().mean()


def _logits(scores: Tensor, group: Tensor | None) -> Tensor:
    """Scores in float32; -inf where a candidate is no negative."""
    logits = scores.float()
    if group is None:
        return logits
    own = torch.eye(len(group), dtype=torch.bool, device=scores.device)
    return logits.masked_fill((group[:, None] == group[None, :]) & ~own, -torch.inf)
