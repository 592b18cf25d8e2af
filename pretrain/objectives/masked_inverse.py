"""MIK and MIK+A: masked multi-step inverse kinematics (Wu et al. 2024, arXiv 2404.14552, section 3 and Table 1).

    P(a_t | f(o_0, a_0, ..., a_{t-1}, o_t), b(o_{t+k}, a_{t+k}, o_{t+k+1}, ...)),   k in 1..K

A forward GRU f summarises the past, a backward GRU b the future from row t+k on; the k steps between are masked.
Only f is kept. "+A" (actions in both) is the field `use_actions` of the encoder.

Authors' code: not published.

Differences and readings:
- The paper's rows are (o_t, a_{t-1}): the future's first, (o_{t+k}, a_{t+k-1}), hands b the last masked action, which
  for k = 1 is the target. Here b reads (o_j, a_j) for j >= t+k, so that it never sees a_t..a_{t+k-1}.
  `literal_future` restores the literal rows, to measure what they do.
- The future of row h is printed as rows min(h+n, H) to H; here it begins at h = t+k, as in the paper's proof.
- An episode's last row has no action: b reads zeros and a flag there.
- The future reaches to the window's end, or n rows beyond t+k (the paper's n is not stated for these experiments);
  the past to the window's start, or m rows before t. Of n+1 rows of the future b reads n+1 actions, not n: each row is
  whole, and given s_{t+k} the last action says nothing more about a_t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.sequence import run_gru_backward, run_gru_over_next
from vd4rl_pomdp.objective import InverseObjective, InverseOptions
from vd4rl_pomdp.options import Limits
from vd4rl_pomdp.types import Windows


@dataclass(frozen=True)
class MaskedOptions(InverseOptions):
    """Options of MIK."""

    n: int | None = None
    """Rows after t+k that the future encoder reads; None: all to the window's end."""

    limits: ClassVar[Limits] = {"n": 0}


@dataclass(frozen=True)
class MaskedActionOptions(MaskedOptions):
    """Options of MIK+A."""

    literal_future: bool = False
    """Give the future encoder a_{t+k-1}, as the paper's rows (o_t, a_{t-1}) have it (a leak at k = 1)."""


class MaskedInverse(InverseObjective):
    """MIK (an encoder that reads observations only) and MIK+A (one that reads actions too)."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: MaskedOptions, seed: int) -> None:
        shape = encoder.config
        super().__init__(encoder, shape.hidden_dim, target, options)
        self.use_actions = shape.use_actions
        self.literal_future = isinstance(options, MaskedActionOptions) and options.literal_future
        self.n = options.n
        inputs = shape.feature_dim + (shape.action_dim + 1 if self.use_actions else 0)
        self.backward_gru = nn.GRU(inputs, shape.hidden_dim, shape.gru_layers, batch_first=True)

    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """Forward states (B, T, D) and backward states (B, T, D)."""
        features = self.encoder.frame(window.obs)
        past = self.encoder.from_features(features, window.prev_action)
        rows = self._future_rows(features, window)
        if self.n is None:
            return past, run_gru_backward(self.backward_gru, rows, window.length)
        return past, run_gru_over_next(self.backward_gru, rows, window.length, self.n + 1)

    def _future_rows(self, features: Tensor, window: Windows) -> Tensor:
        if not self.use_actions:
            return features
        if self.literal_future:
            action, known = window.prev_action, torch.ones_like(window.has_action)
        else:
            action, known = window.action, window.has_action
        return torch.cat([features, action.to(features), known[..., None].to(features)], dim=-1)

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Past up to t and future from t+k on; with actions a_j for j < t and j >= t+k."""
        observations, actions = self.past_visible(t)
        end = rows if self.n is None else min(rows, t + k + self.n + 1)
        observations |= set(range(t + k, end))
        if self.use_actions:
            actions |= set(range(t + k - 1, end - 1) if self.literal_future else range(t + k, end))
        return observations, actions
