"""InfoNCE (van den Oord et al. 2018, arXiv 1807.03748) over a batch of windows."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def info_nce(scores: Tensor, group: Tensor) -> Tensor:
    """Cross-entropy of telling each anchor's own candidate from those of other groups.

    Args:
        scores: (..., N, N), anchors by candidates; the diagonal holds the true pairs.
        group: (N,) int64. Candidates of an anchor's own group are no negatives: in one window they look alike, and
            the papers draw their batches independently.

    Returns:
        Mean over anchors and leading dimensions, in nats. It is log(candidates) when scores tell nothing.
    """
    own = torch.eye(len(group), dtype=torch.bool, device=scores.device)
    barred = (group[:, None] == group[None, :]) & ~own
    logits = scores.float().masked_fill(barred, -torch.inf)
    truth = torch.arange(len(group), device=scores.device).expand(logits.shape[:-1])
    return F.cross_entropy(logits.flatten(0, -2), truth.reshape(-1))
