"""DRIML: deep reinforcement and InfoMax learning (Mazoure et al. 2020, arXiv 2006.07217).

    L = sum over N, M in {local, global} of InfoNCE[ psi_N(s_t, a_t), phi_M(s_{t+k}) ]

A state and its action must identify the state k steps later among the states k steps after all other rows of the batch,
including rows of the same window. "Global" is the encoder's output, "local" each position of its feature map. All four
combinations are trained, each with its own projections. A score is the inner product of the projections / sqrt(64), the
root of their dimension, softly clipped to -20..20.

Authors' code: github.com/bmazoure/DRIML (within a C51 agent for Procgen).

Differences:
- Only the contrastive loss is trained, without the RL agent. The four terms are averaged; the authors weight them.
- Every observation is shifted independently; the authors do not augment (`--shift 0`). A shift shared by a window would
  identify the positive among negatives of other windows, and the loss would fall without any knowledge of the state.
- k is sampled once per batch, from 1..2 by default (`--max-k`); the authors' variant with random k samples it from 1..2
  per transition. Their other variants fix k or adapt it to the game.
- Projections are MLPs with 256 hidden units to 64 dimensions; the authors' are residual blocks to 512.
- Actions are continuous and concatenated to psi's input; the paper embeds discrete actions.
- Feature maps larger than 7x7 are average-pooled to 7x7 (DrQ's convolutions give 35x35).
- A batch consists of windows of consecutive rows, so many negatives are close to the positive in time; the authors
  sample single transitions.
- Observations are shifted independently even if the encoder has a memory (`--history gru`), for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.frame import FrameEncoder
from vd4rl_pomdp.nn.heads import info_nce, mlp
from vd4rl_pomdp.nn.objective import Objective

PLACES = 7
"""Largest height and width of the pooled feature maps."""
SCORE_DIM = 64
TERMS = (("g", "g"), ("g", "l"), ("l", "g"), ("l", "l"))
"""The four terms as (anchor, candidate): g global, l local."""
LARGEST_SCORE = 20.0
"""A tanh bounds scores to +-20."""


@dataclass(frozen=True)
class DRIMLOptions(Options):
    """Options of DRIML."""

    max_k: int = 2
    """Largest gap K between the two states; k is sampled from 1..K once per batch."""

    limits: ClassVar[Limits] = {"max_k": 1}


class DRIML(Objective):
    """Action-conditioned InfoNCE between rows t and t+k, on local and global features."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: DRIMLOptions, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.max_k = options.max_k
        channels, actions = self._frame.map_shape[0], encoder.config.action_dim
        widths = {"g": encoder.dim, "l": channels}
        self.anchors = nn.ModuleDict({n + m: mlp(widths[n] + actions, 256, SCORE_DIM, layers=1) for n, m in TERMS})
        self.candidates = nn.ModuleDict({n + m: mlp(widths[m], 256, SCORE_DIM, layers=1) for n, m in TERMS})
        self.draws = Draws(seed, "driml", "k")

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean of the four InfoNCE terms at one k; `loss_gl`, for example, has a global anchor and local candidates."""
        rows = window.obs.shape[1]
        k = 1 + self.draws.integers(min(self.max_k, rows - 1))
        maps = self._frame.maps(window.obs)
        states = self.encoder.from_features(self._frame.from_maps(maps), window.prev_action)
        # CUDA graphs need the same shapes for every k: there, `real` masks the rows that have no row t+k
        anchors = rows - (int(k) if hardware.in_host_memory(k) else 1)
        there = torch.arange(anchors, device=k.device) + k
        real = (there < window.length[:, None]).flatten()
        there = there.clamp(max=rows - 1)
        action = window.action[:, :anchors].flatten(0, 1)
        features = {"g": states[:, :, None], "l": self._places(maps)}
        now = {n: x[:, :anchors].flatten(0, 1) for n, x in features.items()}
        later = {m: x.index_select(1, there).flatten(0, 1) for m, x in features.items()}
        terms = {f"loss_{n}{m}": info_nce(self._scores(n + m, now[n], action, later[m]), real=real) for n, m in TERMS}
        loss = torch.stack(list(terms.values())).mean()
        return loss, {"loss": loss.detach(), "k": k.float()} | {n: t.detach() for n, t in terms.items()}

    @property
    def _frame(self) -> FrameEncoder:
        assert isinstance(self.encoder.frame, FrameEncoder)
        return self.encoder.frame

    def _places(self, maps: Tensor) -> Tensor:
        """Pool feature maps to at most 7x7 places: (B, T, C, H, W) -> (B, T, places, C)."""
        size = (min(PLACES, maps.shape[-2]), min(PLACES, maps.shape[-1]))
        pooled = F.adaptive_avg_pool2d(maps.float().flatten(0, 1), size)
        return pooled.flatten(2).transpose(1, 2).unflatten(0, maps.shape[:2])

    def _scores(self, term: str, now: Tensor, action: Tensor, later: Tensor) -> Tensor:
        """Scores of anchors by candidates: (N, L or 1, F), (N, A), (N, L or 1, F') -> (L, N, N).

        L counts places: local features are compared at the same place, a global one with every place.
        """
        both = torch.cat([now, action[:, None].expand(-1, now.shape[1], -1).to(now)], dim=-1)
        anchors, candidates = self.anchors[term](both), self.candidates[term](later)
        scores = anchors.transpose(0, 1) @ candidates.permute(1, 2, 0) / SCORE_DIM**0.5
        # tanh instead of clamp, which has no gradient beyond its bounds
        return LARGEST_SCORE * (scores.float() / LARGEST_SCORE).tanh()
