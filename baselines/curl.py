"""CURL: contrastive unsupervised representations (Laskin et al. 2020, arXiv 2004.04136).

    L = -log exp(q^T W k+) / sum_i exp(q^T W k_i),   q = e(aug(o)), k = e'(aug'(o)),   e' <- 0.95 e' + 0.05 e

Two augmentations of one observation form a positive pair; other observations of the batch are negatives. W is a learned
bilinear form and e' a momentum copy of the encoder, without gradient.

Authors' code: github.com/MishaLaskin/curl.

Differences:
- Only the contrastive loss is trained; the paper trains it together with SAC on the same encoder.
- Augmentation is a random shift by up to 4 pixels, as everywhere in this benchmark, not a random crop of a larger
  frame. Both copies are shifted versions of one corrupted, unshifted observation: the corruption belongs to the
  environment, not to the augmentation, and a shift common to both copies would distinguish them from the negatives.
- The paper subtracts each row's largest logit before the softmax; here log-softmax does that.
- Observations of the anchor's own window are not negatives. The authors sample single observations from a buffer, of
  which hardly two are neighbours in time.
- The authors contrast 50 features after a layer norm without tanh; here it is the encoder's own output.
- They update e' every second step (also by 0.05) and step the encoder with two optimisers; here it is every step and
  one optimiser.
- With `--history gru` the GRU is part of e and e', and a window is shifted as a whole.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.corruptions.augmentation import random_shift
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.heads import info_nce, move_target, share_found
from vd4rl_pomdp.nn.objective import Objective

MOMENTUM = 0.05
"""tau in e' <- (1 - tau) e' + tau e, after every step."""


class CURL(Objective):
    """Instance discrimination with a momentum encoder."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: Options, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.momentum_encoder = copy.deepcopy(encoder).requires_grad_(False)
        self.bilinear = nn.Parameter(torch.rand(encoder.dim, encoder.dim))  # from 0 to 1, as the authors draw it
        self.draws = Draws(seed, "curl", "shift")

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        query = self.encoder.encode(self._shifted(window))
        with torch.no_grad():
            positive = self.momentum_encoder.encode(self._shifted(window))
        batch, rows = query.shape[:2]
        group = torch.arange(batch, device=query.device).repeat_interleave(rows)
        # flattened over windows and rows; rows of the anchor's own group (window) are not negatives
        scores = query.flatten(0, 1) @ self.bilinear @ positive.flatten(0, 1).T
        counted = group, window.real.flatten()
        loss = info_nce(scores, *counted)
        return loss, {"loss": loss.detach(), "accuracy": share_found(scores, *counted)}

    def after_step(self) -> None:
        move_target(self.momentum_encoder, self.encoder, MOMENTUM)

    def _shifted(self, window: Windows) -> Windows:
        """The window with a new random shift: per row, or one for the whole window if the encoder has a memory."""
        obs = window.obs if self.encoder.memory is not None else window.obs.flatten(0, 1)
        return window.replace(obs=random_shift(obs, self.draws.keys(len(obs))).view_as(window.obs))
