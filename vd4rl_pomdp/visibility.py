"""Visibility proofs: what an inverse model's predictions depend on, by gradients, against what it declares.

A prediction that sees the action it is asked for, or less than it claims, gives numbers that mean something else than
its name. Gradients of every logit with respect to every observation and action show both, in float64 on small windows.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from vd4rl_pomdp.objective import InverseObjective
from vd4rl_pomdp.types import Windows

Seen = tuple[set[int], set[int]]
"""Observation rows j (of o_j) and action indices j (of a_j)."""


def wrong_pairs(objective: InverseObjective, lengths: Sequence[int], rows: int = 6) -> list[tuple[int, int, int]]:
    """Pairs whose prediction depends on other rows or actions than `objective.visible` declares.

    Args:
        objective: a small one (few units, few features): the proof takes a backward pass for every pair.
        lengths: real rows of each window of the batch; the first ends inside its episode, the others at an end.
        rows: rows T of the windows, padding included.

    Returns:
        (window, t, k) of every pair that is wrong; empty if all hold.

    Raises:
        ValueError: a window's predictions depend on another window of the batch.
    """
    return [
        (b, t, k)
        for (b, t, k), seen in dependence(objective, lengths, rows).items()
        if seen != declared(objective, t, k, lengths[b], last_action=b == 0)
    ]


def declared(objective: InverseObjective, t: int, k: int, length: int, last_action: bool) -> Seen:
    """What `objective` declares visible; `last_action` tells whether the window's last row has an action."""
    rows, actions = objective.visible(t, k, length)
    return rows, {a for a in actions if a < length - 1 or last_action}


def dependence(objective: InverseObjective, lengths: Sequence[int], rows: int = 6) -> dict[tuple[int, int, int], Seen]:
    """(window, t, k) -> what the prediction has a gradient to, for all real pairs; see `wrong_pairs`."""
    objective = objective.double()
    window, obs, actions = _differentiable_window(objective, lengths, rows)
    logits = objective.action_logits(window)
    weights = torch.randn(logits.shape[-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = {}
    for p, (t, k) in enumerate(objective.pairs(rows).tolist()):
        for b, length in enumerate(lengths):
            if t + k < length:
                value = (logits[b, p] * weights).sum()
                grads = torch.autograd.grad(value, (obs, actions), retain_graph=True, allow_unused=True)
                found[b, t, k] = (_rows_with_gradient(grads[0], b), _rows_with_gradient(grads[1], b))
    return found


def _rows_with_gradient(grad: torch.Tensor | None, window: int) -> set[int]:
    if grad is None:
        return set()
    touched = grad.flatten(2).abs().amax(2) > 0
    if touched[torch.arange(len(touched)) != window].any():
        raise ValueError("a prediction depends on another window of its batch")
    return set(torch.nonzero(touched[window])[:, 0].tolist())


def _differentiable_window(
    objective: InverseObjective, lengths: Sequence[int], rows: int
) -> tuple[Windows, torch.Tensor, torch.Tensor]:
    """A random window whose observations and actions a_0..a_{T-1} carry gradients."""
    shape = objective.encoder.config
    g = torch.Generator().manual_seed(0)
    size = (len(lengths), rows, shape.channels, shape.size, shape.size)
    obs = (torch.rand(size, generator=g, dtype=torch.float64) * 255).requires_grad_()
    actions = torch.rand(*size[:2], shape.action_dim, generator=g, dtype=torch.float64).sub(0.5).requires_grad_()
    length = torch.tensor(lengths)
    has_action = torch.arange(rows) < length[:, None] - 1
    has_action[0] = torch.arange(rows) < length[0]
    action = actions * has_action[..., None]
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], 1)
    key = torch.zeros(size[:2], dtype=torch.int64)
    return Windows(obs, prev_action, action, has_action, length, key), obs, actions
