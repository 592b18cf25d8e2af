"""MIK and MIK+A: masked multi-step inverse kinematics (Wu et al. 2024, arXiv 2404.14552, section 3 and Table 1).

    P(a_t | f(o_0, a_0, ..., a_{t-1}, o_t), b(o_{t+k}, a_{t+k}, o_{t+k+1}, ...)),   k in 1..K

A forward GRU f summarises the past, a backward GRU b the future from row t+k on. The k steps between are masked by
never being read: a pair takes f's state of row t and b's of row t+k. The loss on them is `InverseObjective.loss_of`.
Only f is kept. "+A" (actions in both) is the field `use_actions` of the encoder.

Authors' code: not published.

Differences and readings:
- The paper's rows are (o_t, a_{t-1}): the future's first, (o_{t+k}, a_{t+k-1}), hands b the last masked action, which
  for k = 1 is the target. Here b reads (o_j, a_j) for j >= t+k, so that it never sees a_t..a_{t+k-1}.
  `literal_future` restores the literal rows, to measure what they do.
- An observation is a stack of the frames j-2..j, so that o_{t+k} shows up to two frames of masked steps, in the paper's
  setting, too. `future_frames` blanks them: b's state of row t+k then reads that row with its newest frame alone, the
  next one without its oldest.
- The future of row h is printed as rows min(h+n, H) to H; here it begins at h = t+k, as in the paper's proof.
- An episode's last row has no action: b reads zeros and a flag there.
- The future reaches to the window's end, or n rows beyond t+k (the paper's n is not stated for these experiments);
  the past to the window's start, or m rows before t. Of n+1 rows of the future b reads n+1 actions, not n: each row is
  whole, and given s_{t+k} the last action says nothing more about a_t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.memory import run_backward, run_over_next, run_over_versions
from vd4rl_pomdp.nn.objective import InverseObjective, InverseOptions


@dataclass(frozen=True)
class MaskedOptions(InverseOptions):
    """Options of MIK."""

    n: int | None = None
    """Rows after t+k that the future encoder reads; None: all to the window's end."""

    future_frames: Literal["all", "newest"] = "all"
    """Frames of the future's first observations: all, of which up to two are of masked steps, or newest, where those
    before t+k are blanked."""

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
        self.newest = options.future_frames == "newest"
        if self.newest and encoder.frame_stack == 1:
            raise UserError(
                "--future-frames newest blanks older frames of a stack, and here an observation is one frame: "
                "leave it out"
            )
        inputs = shape.feature_dim + (shape.action_dim + 1 if self.use_actions else 0)
        # weights of its own: it reads time backwards, and only f is kept
        self.backward_memory = encoder.make_memory(inputs)

    def representations(self, window: Windows) -> tuple[Tensor, Tensor]:
        """Forward states (B, T, D) and backward states (B, T, D)."""
        features = self.encoder.frame(window.obs)
        past = self.encoder.from_features(features, window.prev_action)
        rows = self._future_rows(features, window)
        if self.newest:
            blanked = [self._future_rows(self.encoder.frame(obs), window) for obs in self._blanked(window.obs)]
            span = None if self.n is None else self.n + 1
            return past, run_over_versions(self.backward_memory, [*blanked, rows], window.length, span)
        # b runs from the window's end down, so that its state of row t+k has met no row, and no action, before t+k:
        # what a pair masks is never an input, where zeros in its place would be one
        if self.n is None:
            return past, run_backward(self.backward_memory, rows, window.length)
        return past, run_over_next(self.backward_memory, rows, window.length, self.n + 1)

    def _blanked(self, obs: Tensor) -> list[Tensor]:
        """Observations as a future's first row, its second, ...: without the frames of before the first."""
        stack = self.encoder.frame_stack
        older = (3 * frames for frames in range(stack - 1, 0, -1))
        return [torch.cat([torch.zeros_like(obs[:, :, :c]), obs[:, :, c:]], dim=2) for c in older]

    def _future_rows(self, features: Tensor, window: Windows) -> Tensor:
        if not self.use_actions:
            return features
        if self.literal_future:
            action, known = window.prev_action, torch.ones_like(window.has_action)
        else:
            action, known = window.action, window.has_action
        # an action of zeros can be taken: the flag tells it from none
        return torch.cat([features, action.to(features), known[..., None].to(features)], dim=-1)

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Past up to t and future from t+k on; with actions a_j for j < t and j >= t+k."""
        observations, actions = self.past_visible(t)
        read = (rows if self.n is None else self.n + 1, self.backward_memory.reach or rows)
        end = min(rows, t + k + min(read))
        future = range(t + k, end)
        observations |= set(future[-1:] if self.backward_memory.first_only else future)
        if self.use_actions:
            actions |= set(range(t + k - 1, end - 1) if self.literal_future else range(t + k, end))
        return observations, actions

    def visible_frames(self, t: int, k: int, rows: int) -> set[int]:
        """All of the stacks, or all but those of masked steps: the past's last stack shows what else is blanked."""
        frames = super().visible_frames(t, k, rows)
        return frames - set(range(t + 1, t + k)) if self.newest else frames
