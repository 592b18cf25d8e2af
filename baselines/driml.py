"""DRIML: deep reinforcement and InfoMax learning (Mazoure et al. 2020, arXiv 2006.07217).

    L = sum over N, M in {local, global} of InfoNCE[ psi_N(s_t, a_t), phi_M(s_{t+k}) ]

A state and its action must tell the state k steps later from those k steps after all other rows of the batch, those of
its own window among them. "Global" is the encoder's output, "local" its feature map, place by place; all four
combinations are trained, each with projections of its own. A score is the inner product of projections over sqrt(64),
softly clipped to -20..20.

Authors' code: github.com/bmazoure/DRIML (within a C51 agent for Procgen).

Differences:
- The contrastive loss alone, without the reward-driven agent; the mean of all four terms, which the authors weigh.
- Every observation is shifted by itself; the authors do not augment (`--shift 0`). A shift that a window shares would
  tell the positive from all negatives of other windows, and the loss would fall without any knowledge of the state.
- k is drawn for every batch, from 1..2 as the authors' variant with random k draws it for every transition;
  `--max-k` sets another K. Their other variants fix it or adapt it to the game.
- Actions are continuous and enter psi by concatenation; the paper embeds discrete ones.
- Feature maps larger than 7x7 are averaged to 7x7 (DrQ's convolutions leave 35x35 places).
- A batch is windows of consecutive rows, so that many negatives are near the positive in time; the authors draw theirs
  one by one.
- Batches of windows whose encoder has a memory (`--history gru`) are shifted row by row, too, for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.core import buffers
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.frame import FrameEncoder
from vd4rl_pomdp.nn.heads import info_nce, mlp
from vd4rl_pomdp.nn.objective import Objective

PLACES = 7
"""Largest height and width of the local maps."""
SCORE_DIM = 64
TERMS = (("g", "g"), ("g", "l"), ("l", "g"), ("l", "l"))
"""What is contrasted, the anchor's feature and the candidate's: g global, l local."""
LARGEST_SCORE = 20.0
"""Scores are clipped to this by a tanh."""


@dataclass(frozen=True)
class DRIMLOptions(Options):
    """Options of DRIML."""

    max_k: int = 2
    """Largest gap K between the two states; k is drawn from 1..K for every batch."""

    limits: ClassVar[Limits] = {"max_k": 1}


class DRIML(Objective):
    """Action-conditioned InfoNCE across k steps, on local and global features."""

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
        """Mean of the four InfoNCE terms at one k; `loss_gl` is a global anchor with local candidates."""
        rows = window.obs.shape[1]
        k = 1 + self.draws.integers(min(self.max_k, rows - 1))
        maps = self._frame.maps(window.obs)
        states = self.encoder.from_features(self._frame.from_maps(maps), window.prev_action)
        # a step that is replayed has one shape, whatever k is: there rows that have no later one are left out by `real`
        anchors = rows - (int(k) if buffers.in_host_memory(k) else 1)
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
        """(B, T, C, H, W) -> (B, T, places, C), at most 7x7 places."""
        size = (min(PLACES, maps.shape[-2]), min(PLACES, maps.shape[-1]))
        pooled = F.adaptive_avg_pool2d(maps.float().flatten(0, 1), size)
        return pooled.flatten(2).transpose(1, 2).unflatten(0, maps.shape[:2])

    def _scores(self, term: str, now: Tensor, action: Tensor, later: Tensor) -> Tensor:
        """(N, L or 1, F), (N, A), (N, L or 1, F') -> (L, N, N): place against the same place, or against the whole."""
        both = torch.cat([now, action[:, None].expand(-1, now.shape[1], -1).to(now)], dim=-1)
        anchors, candidates = self.anchors[term](both), self.candidates[term](later)
        scores = anchors.transpose(0, 1) @ candidates.permute(1, 2, 0) / SCORE_DIM**0.5
        # soft, because beyond a hard bound no gradient would bring a score back
        return LARGEST_SCORE * (scores.float() / LARGEST_SCORE).tanh()
