"""MIK and MIK+A: masked multi-step inverse kinematics (Wu et al. 2024, arXiv 2404.14552, section 3 and Table 1).

    P(a_t | f(o_0, a_0, ..., a_{t-1}, o_t), b(o_{t+k}, a_{t+k}, o_{t+k+1}, ...)),   k in 1..K

A forward GRU f summarises the past and a backward GRU b the future from row t+k on. A pair uses f's state at row t and
b's at row t+k, so the steps in between are masked by never being read. The loss is `InverseObjective.loss_of`. Only f
is kept after pretraining. "+A" (both GRUs also read actions) is the encoder's field `use_actions`.

Authors' code: not published.

Differences and readings:
- The paper's rows are (o_t, a_{t-1}). Read literally, the future's first row (o_{t+k}, a_{t+k-1}) gives b the last
  masked action, which is the target if k = 1. Here b reads (o_j, a_j) for j >= t+k and never sees a_t..a_{t+k-1}.
  `literal_future` restores the paper's rows, to measure that leak.
- Observation o_j stacks frames j-2..j, so o_{t+k} shows up to two frames of masked steps; this holds in the paper's
  setting, too. `future_frames` blanks them: for a pair (t, k), b reads row t+k with its newest frame only and row t+k+1
  without its oldest frame.
- The paper prints the future of row h as rows min(h+n, H) to H; here it begins at h = t+k, as in the paper's proof.
- An episode's last row has no action: b reads zeros there and a flag that says so.
- The future extends to the window's end, or to n rows after t+k (the paper does not state n for these experiments);
  the past extends to the window's start, or to m rows before t. With n+1 rows of future b reads n+1 actions, not n:
  given s_{t+k} the last action carries no further information about a_t.
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
    """Rows after t+k that the future encoder reads; None: all up to the window's end."""

    future_frames: Literal["all", "newest"] = "all"
    """Frames that the future shows: all, of which up to two belong to masked steps.
    Or newest, which blanks the frames before t+k."""

    limits: ClassVar[Limits] = {"n": 0}


@dataclass(frozen=True)
class MaskedActionOptions(MaskedOptions):
    """Options of MIK+A."""

    literal_future: bool = False
    """Also give the future encoder a_{t+k-1}, as in the paper's rows (o_t, a_{t-1}); at k = 1 this leaks the target."""


class MaskedInverse(InverseObjective):
    """MIK (the encoder reads observations only) and MIK+A (it also reads actions)."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: MaskedOptions, seed: int) -> None:
        shape = encoder.config
        super().__init__(encoder, shape.hidden_dim, target, options)
        self.use_actions = shape.use_actions
        self.literal_future = isinstance(options, MaskedActionOptions) and options.literal_future
        self.n = options.n
        self.newest = options.future_frames == "newest"
        if self.newest and encoder.frame_stack == 1:
            raise UserError(
                "--future-frames newest blanks older frames of a stack, but observations here have one frame: "
                "leave it out"
            )
        inputs = shape.feature_dim + (shape.action_dim + 1 if self.use_actions else 0)
        # does not share f's weights: it reads time backwards, and only f is kept
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
        # b runs from the window's end backwards, so its state at row t+k depends on no row and no action before t+k.
        # Masked rows are thus never an input; zeros in their place would be one.
        if self.n is None:
            return past, run_backward(self.backward_memory, rows, window.length)
        return past, run_over_next(self.backward_memory, rows, window.length, self.n + 1)

    def _blanked(self, obs: Tensor) -> list[Tensor]:
        """Copies of `obs` for use as the future's first row, its second, ...: frames older than t+k are zeroed.

        With stacks of 3 frames: [newest frame only, newest two frames].
        """
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
        # the flag distinguishes "no action" from an action of zeros
        return torch.cat([features, action.to(features), known[..., None].to(features)], dim=-1)

    def visible(self, t: int, k: int, rows: int) -> tuple[set[int], set[int]]:
        """Observations up to t and from t+k on; with actions, also a_j for j < t and j >= t+k."""
        observations, actions = self.past_visible(t)
        read = (rows if self.n is None else self.n + 1, self.backward_memory.reach or rows)
        end = min(rows, t + k + min(read))
        future = range(t + k, end)
        observations |= set(future[-1:] if self.backward_memory.first_only else future)
        if self.use_actions:
            actions |= set(range(t + k - 1, end - 1) if self.literal_future else range(t + k, end))
        return observations, actions

    def visible_frames(self, t: int, k: int, rows: int) -> set[int]:
        """Frames of the visible stacks; with `newest`, without those of the masked steps t+1..t+k-1."""
        frames = super().visible_frames(t, k, rows)
        return frames - set(range(t + 1, t + k)) if self.newest else frames
