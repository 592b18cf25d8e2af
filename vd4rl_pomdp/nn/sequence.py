"""Recurrent passes over windows, forwards and backwards, that padding cannot reach."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad


def run_gru(gru: nn.GRU, x: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Run a batch-first GRU in its own precision, also inside autocast: (B, T, I) -> (B, T, H), (layers, B, H)."""
    with torch.autocast(x.device.type, enabled=False):
        return gru(x.to(next(gru.parameters()).dtype), state)


def run_gru_backward(gru: nn.GRU, x: Tensor, length: Tensor) -> Tensor:
    """Run a GRU from each window's last real row to its first.

    Args:
        gru: a batch-first, one-directional GRU.
        x: (B, T, I) inputs; rows at and after `length` are padding.
        length: (B,) int64.

    Returns:
        (B, T, H): row j has seen rows j..length-1. Padding rows mean nothing and must not be used.
    """
    rows = torch.arange(x.shape[1], device=x.device)
    flip = length[:, None] - 1 - rows
    flip = torch.where(flip >= 0, flip, rows)  # padding stays behind the real rows
    out, _ = run_gru(gru, _take_rows(x, flip))
    return _take_rows(out, flip)


def run_gru_over_next(gru: nn.GRU, x: Tensor, length: Tensor, span: int) -> Tensor:
    """Like `run_gru_backward`, but row j has seen rows j..j+span-1 alone: each state is computed anew from zero."""
    batch, rows, width = x.shape
    span = min(span, rows)
    j = torch.arange(rows, device=x.device)
    count = (length[:, None] - j).clamp(1, span)  # padding rows read themselves
    index = (j[:, None] + count[..., None] - 1 - torch.arange(span, device=x.device)).maximum(j[:, None])
    windows = _take_rows(x, index.view(batch, -1)).view(batch * rows, span, width)
    out, _ = run_gru(gru, windows)
    last = (count - 1).reshape(-1, 1)
    return _take_rows(out, last).view(batch, rows, -1)


def run_gru_over_versions(gru: nn.GRU, versions: Sequence[Tensor], length: Tensor, span: int | None = None) -> Tensor:
    """Like `run_gru_backward`, or `run_gru_over_next` if there is a span, with rows that differ by the state they are
    read for.

    Args:
        gru: a batch-first, one-directional GRU.
        versions: V tensors (B, T, I); the state of row j reads row j+i in version i, or V-1 if that is less.
        length: (B,) int64.
        span: rows that a state reads; None: all to the window's end.

    Returns:
        (B, T, H).
    """
    last = len(versions) - 1
    batch, rows, _ = versions[0].shape
    hidden = next(gru.parameters()).new_zeros(gru.num_layers, batch, gru.hidden_size)
    states = [hidden] * (rows + last)
    if span is None:  # from row j+V-1 on all states read the same rows, so one pass over these serves them
        for j in reversed(range(rows)):
            states[j] = hidden = torch.where(
                (j < length)[:, None], run_gru(gru, versions[last][:, j, None], hidden)[1], hidden
            )
        own = last
    else:
        own = min(span, rows)
    hidden = torch.stack(states[last:], dim=2).flatten(1, 2)
    real = torch.arange(rows, device=length.device) < length[:, None]
    for i in reversed(range(own)):
        ahead = pad(versions[min(i, last)][:, i:], (0, 0, 0, min(i, rows)))
        there = pad(real[:, i:], (0, min(i, rows))).flatten()
        hidden = torch.where(there[:, None], run_gru(gru, ahead.flatten(0, 1)[:, None], hidden)[1], hidden)
    return hidden[-1].view(batch, rows, -1)


def _take_rows(x: Tensor, index: Tensor) -> Tensor:
    """Rows of (B, T, I) in the order given by (B, T) indices."""
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[2]))
