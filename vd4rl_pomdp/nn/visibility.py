"""Visibility checks: compare what an inverse model's predictions depend on with what it declares in `visible`.

If a prediction sees its target action, or less than the method claims, the results are not that method's. Two checks
in float64 on small windows find this: the gradient of every logit with respect to every observation and action, and
whether the logits change when one of these inputs changes. The second also finds dependence without gradient: detached
copies, rounded or compared values.

An observation is a stack of frames, so a hidden row's frame can appear in a visible row's stack. With `frames=True`,
both checks therefore work on single frames instead of rows.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from vd4rl_pomdp.core.types import Windows, previous
from vd4rl_pomdp.nn.objective import InverseObjective

Seen = tuple[set[int], set[int]]
"""(observations, actions): indices j of o_j, or of single frames (frame j is the newest of o_j), and of a_j."""
Pair = tuple[int, int, int]
"""(window, t, k)."""


def wrong_pairs(objective: InverseObjective, lengths: Sequence[int], rows: int = 6, frames: bool = False) -> list[Pair]:
    """Find pairs whose prediction depends on other inputs than `objective.visible` declares.

    A pair passes if the inputs with a nonzero gradient, the inputs that change the prediction, and the declared inputs
    are the same sets.

    Args:
        objective: a small one, since each pair takes a backward pass; but some 30 units in the head, or its ReLUs may
            all be zero for a pair. It is converted to float64 in place.
        lengths: real rows of each window of the batch. The first window ends inside its episode, the others at its end.
        rows: rows T of each window, padding included.
        frames: check single frames against `objective.visible_frames` instead of rows.

    Raises:
        ValueError: a prediction depends on another window of the batch, or differs from call to call.
    """
    felt = response(objective, lengths, rows, frames)
    return [
        (b, t, k)
        for (b, t, k), seen in dependence(objective, lengths, rows, frames).items()
        if not seen == felt[b, t, k] == declared(objective, t, k, lengths[b], b == 0, frames)
    ]


def declared(objective: InverseObjective, t: int, k: int, length: int, last_action: bool, frames: bool = False) -> Seen:
    """Inputs that `objective` declares visible for (t, k); `last_action`: the window's last row has an action."""
    rows, actions = objective.visible(t, k, length)
    seen = objective.visible_frames(t, k, length) if frames else rows
    return seen, {a for a in actions if a < length - 1 or last_action}


def dependence(
    objective: InverseObjective, lengths: Sequence[int], rows: int = 6, frames: bool = False
) -> dict[Pair, Seen]:
    """(window, t, k) -> inputs with a nonzero gradient, for all real pairs; arguments as `wrong_pairs`."""
    objective = objective.double()
    inputs = obs, actions = [x.requires_grad_() for x in _inputs(objective, lengths, rows, frames, seed=0)]
    logits = _logits(objective, _window(obs, actions, lengths))
    weights = torch.randn(logits.shape[-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = {}
    for p, (b, t, k) in _real_pairs(objective, lengths, rows):
        value = (logits[b, p] * weights).sum()
        grads = torch.autograd.grad(value, inputs, retain_graph=True, allow_unused=True)
        reached: list[set[int]] = []
        for grad in grads:
            touched = torch.zeros(len(lengths), 1) if grad is None else grad.flatten(2).abs().amax(2)
            if touched[torch.arange(len(lengths)) != b].any():
                raise ValueError("a prediction depends on another window of its batch")
            reached.append(set(torch.nonzero(touched[b])[:, 0].tolist()))
        found[b, t, k] = ({place - (obs.shape[1] - rows) for place in reached[0]}, reached[1])
    return found


@torch.no_grad()
def response(
    objective: InverseObjective, lengths: Sequence[int], rows: int = 6, frames: bool = False
) -> dict[Pair, Seen]:
    """(window, t, k) -> inputs whose change alters the prediction, for all real pairs; arguments as `wrong_pairs`."""
    objective = objective.double()
    (obs, actions), (new_obs, new_actions) = (_inputs(objective, lengths, rows, frames, seed) for seed in (0, 2))
    plain = _logits(objective, _window(obs, actions, lengths))

    def changed(obs: Tensor, actions: Tensor) -> Tensor:
        return (_logits(objective, _window(obs, actions, lengths)) != plain).any(-1)

    if changed(obs, actions).any():
        raise ValueError(
            "predictions differ between calls: put the objective into eval mode, or draw from nn.draws.Draws"
        )
    for b in range(len(lengths)):
        touched = changed(_exchange(obs, new_obs, 0, b), _exchange(actions, new_actions, 0, b))
        if touched[torch.arange(len(lengths)) != b].any():
            raise ValueError("a prediction depends on another window of its batch")
    found: dict[Pair, Seen] = {pair: (set(), set()) for _, pair in _real_pairs(objective, lengths, rows)}
    before = obs.shape[1] - rows
    for kind, place in [(0, place) for place in range(obs.shape[1])] + [(1, row) for row in range(rows)]:
        if kind == 0:
            touched = changed(_exchange(obs, new_obs, 1, place), actions)
        else:
            touched = changed(obs, _exchange(actions, new_actions, 1, place))
        for p, pair in _real_pairs(objective, lengths, rows):
            if touched[pair[0], p]:
                found[pair][kind].add(place if kind else place - before)
    return found


def _logits(objective: InverseObjective, window: Windows) -> Tensor:
    """Predictions by a copy, so that a method whose `Draws` move on makes the same draws at every call."""
    return copy.deepcopy(objective).action_logits(window)


def _real_pairs(objective: InverseObjective, lengths: Sequence[int], rows: int) -> Iterator[tuple[int, Pair]]:
    """Yield (index among the pairs, (window, t, k)) for every pair within its window's real rows."""
    for p, (t, k) in enumerate(objective.pairs(rows).tolist()):
        yield from ((p, (b, t, k)) for b, length in enumerate(lengths) if t + k < length)


def _exchange(values: Tensor, others: Tensor, axis: int, place: int) -> Tensor:
    """Copy of `values` with the slice at `place` along `axis` taken from `others`."""
    return values.index_copy(axis, torch.tensor([place]), others.narrow(axis, place, 1))


def _inputs(
    objective: InverseObjective, lengths: Sequence[int], rows: int, frames: bool, seed: int
) -> tuple[Tensor, Tensor]:
    """Random float64 observations and actions (B, T, A), padding included.

    Observations are (B, T, C, H, W), or with `frames` (B, S-1+T, C/S, H, W) for stacks of S, oldest frame first.
    """
    shape = objective.encoder.config
    stack = objective.encoder.frame_stack if frames else 1
    g = torch.Generator().manual_seed(seed)
    size = (len(lengths), stack - 1 + rows, shape.channels // stack, shape.size, shape.size)
    obs = torch.rand(size, generator=g, dtype=torch.float64) * 255
    return obs, torch.rand(len(lengths), rows, shape.action_dim, generator=g, dtype=torch.float64) - 0.5


def _window(obs: Tensor, actions: Tensor, lengths: Sequence[int]) -> Windows:
    """Windows from `_inputs`; the first ends inside its episode, the others at its end."""
    rows, length = actions.shape[1], torch.tensor(lengths)
    obs = torch.cat([obs[:, first : first + rows] for first in range(obs.shape[1] - rows + 1)], dim=2)
    has_action = torch.arange(rows) < length[:, None] - 1
    has_action[0] = torch.arange(rows) < length[0]
    action = actions * has_action[..., None]
    key = torch.zeros(obs.shape[:2], dtype=torch.int64)
    return Windows(obs, previous(action), action, has_action, length, key)
