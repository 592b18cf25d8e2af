"""DRIML: deep reinforcement and InfoMax learning (Mazoure et al. 2020, arXiv 2006.07217).

    L = sum over N, M in {local, global} of InfoNCE[ psi_N(s_t, a_t), phi_M(s_{t+k}) ]

A state and its action must tell the state k steps later from other states. "Global" is the encoder's output, "local"
its feature map, place by place; all four combinations are trained. Scores are inner products of projections.

Authors' code: github.com/bmazoure/DRIML (within a C51 agent for Procgen).

Differences:
- The contrastive loss alone, without the reward-driven agent.
- k is drawn anew from 1..K for every batch; the paper fixes it or adapts it to the game.
- Actions are continuous and enter psi by concatenation; the paper embeds discrete ones.
- Feature maps larger than 7x7 are averaged to 7x7 (DrQ's convolutions leave 35x35 places).
- States of the anchor's own window are no negatives (see `info_nce`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.contrastive import info_nce
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.frame import FrameEncoder
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.objective import Objective
from vd4rl_pomdp.options import Limits, Options
from vd4rl_pomdp.types import Windows

PLACES = 7
"""Largest height and width of the local maps."""
SCORE_DIM = 64


@dataclass(frozen=True)
class DRIMLOptions(Options):
    """Options of DRIML."""

    max_k: int = 15
    """Largest gap K between the two states; k is drawn from 1..K for every batch."""

    limits: ClassVar[Limits] = {"max_k": 1}


class DRIML(Objective):
    """Action-conditioned InfoNCE across k steps, on local and global features."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: DRIMLOptions, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.max_k = options.max_k
        channels, actions = self._frame.map_shape[0], encoder.config.action_dim
        widths = {"global": encoder.dim, "local": channels}
        self.anchors = nn.ModuleDict({n: mlp(w + actions, 256, SCORE_DIM, layers=1) for n, w in widths.items()})
        self.candidates = nn.ModuleDict({n: mlp(w, 256, SCORE_DIM, layers=1) for n, w in widths.items()})
        self.draws = Draws(seed, "driml", "k")

    def loss(self, window: Windows, progress: float) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean of the four InfoNCE terms at one k; `loss_gl` is a global anchor with local candidates."""
        batch, rows = window.obs.shape[:2]
        k = 1 + int(self.draws.integers(min(self.max_k, rows - 1), 1))
        maps = self._frame.maps(window.obs)
        states = self.encoder.from_features(self._frame.from_maps(maps), window.prev_action)
        features = {"global": states[:, :, None], "local": self._places(maps)}
        real = window.real[:, k:]
        group = torch.arange(batch, device=states.device)[:, None].expand(-1, rows - k)[real]
        action = window.action[:, :-k][real]
        anchors = {n: self._anchor(n, x[:, :-k][real], action) for n, x in features.items()}
        candidates = {n: self.candidates[n](x[:, k:][real]) for n, x in features.items()}
        terms = {
            f"loss_{n[0]}{m[0]}": info_nce(_scores(anchors[n], candidates[m]), group)
            for n in features
            for m in features
        }
        loss = torch.stack(list(terms.values())).mean()
        return loss, {"loss": loss.detach(), "k": torch.tensor(float(k))} | {n: t.detach() for n, t in terms.items()}

    @property
    def _frame(self) -> FrameEncoder:
        assert isinstance(self.encoder.frame, FrameEncoder)
        return self.encoder.frame

    def _places(self, maps: Tensor) -> Tensor:
        """(B, T, C, H, W) -> (B, T, places, C), at most 7x7 places."""
        size = (min(PLACES, maps.shape[-2]), min(PLACES, maps.shape[-1]))
        pooled = F.adaptive_avg_pool2d(maps.float().flatten(0, 1), size)
        return pooled.flatten(2).transpose(1, 2).unflatten(0, maps.shape[:2])

    def _anchor(self, name: str, features: Tensor, action: Tensor) -> Tensor:
        """(N, L, F) features with (N, A) actions -> (N, L, S)."""
        both = torch.cat([features, action[:, None].expand(-1, features.shape[1], -1).to(features)], dim=-1)
        return self.anchors[name](both)


def _scores(anchors: Tensor, candidates: Tensor) -> Tensor:
    """(N, L or 1, S) and (N, L or 1, S) -> (L, N, N): place against the same place, or against the whole."""
    return anchors.transpose(0, 1) @ candidates.permute(1, 2, 0) / SCORE_DIM**0.5
