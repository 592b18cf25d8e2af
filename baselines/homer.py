"""HOMER: kinematic inseparability by classifying real against imposter transitions (Misra et al., arXiv 1911.05815).

    P(real | e(o_t), a_t, c(e(o_{t+1}))),   imposters: o_{t+1} sampled independently of (o_t, a_t)

The Bayes-optimal classifier is p(o'|o,a) / (p(o'|o,a) + p(o')), so observations that no (o, a) distinguishes may share
a code. c is a discrete bottleneck (Gumbel-softmax over a few codes) or the identity.

Authors' code: github.com/microsoft/Intrepid (Homer).

Differences:
- Only the state abstraction is learned: no exploration policies, no tabular planning on the codes.
- One encoder for o_t and o_{t+1}; the authors share the convolutions, use a separate last layer for each, and keep the
  second.
- The imposter of a real transition is a next observation sampled uniformly from the batch; there is one per transition.
- Every observation is shifted independently; the authors do not augment (`--shift 0`). A shift shared by a window would
  distinguish real transitions from imposters of other windows.
- The authors train without the bottleneck first and then add it; here it is used from the start or not at all.
- The bottleneck's sample is one-hot with a straight-through gradient and a learned embedding; the authors' is soft, and
  its embedding the identity.
- The bottleneck is optional (`--homer-codes`), since TD3+BC needs a continuous state; the saved representation is the
  one before it.
- With `--history gru` the state at t+1 remembers row t, which makes imposters easy to spot. Interpret it accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.nn.objective import Objective


class Bottleneck(nn.Module):
    """Straight-through Gumbel-softmax (Jang et al. 2016, arXiv 1611.01144) over `codes` codes: (N, D) -> (N, D)."""

    def __init__(self, dim: int, codes: int, seed: int) -> None:
        super().__init__()
        self.logits = nn.Linear(dim, codes)
        self.embedding = nn.Linear(codes, dim, bias=False)
        self.draws = Draws(seed, "homer", "gumbel")

    def forward(self, z: Tensor) -> Tensor:
        """Embedding of each row's code; with Gumbel noise in training mode only."""
        logits = self.logits(z)
        if self.training:
            logits = logits - (-self.draws.uniform(*logits.shape).log()).log()
        soft = logits.softmax(-1)
        hard = (logits.argmax(-1, keepdim=True) == torch.arange(soft.shape[-1], device=soft.device)).to(soft)
        return self.embedding(hard + soft - soft.detach())  # one-hot forward, softmax gradient backward


@dataclass(frozen=True)
class HOMEROptions(Options):
    """Options of HOMER."""

    homer_codes: int = 0
    """Number of codes of the discrete bottleneck; 0: no bottleneck."""

    limits: ClassVar[Limits] = {"homer_codes": 0}


class HOMER(Objective):
    """Classifies transitions (o_t, a_t, o_{t+1}) as real or imposter."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: HOMEROptions, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.bottleneck = Bottleneck(encoder.dim, options.homer_codes, seed) if options.homer_codes else nn.Identity()
        self.classifier = mlp(2 * encoder.dim + encoder.config.action_dim, 256, 1)
        self.draws = Draws(seed, "homer", "imposters")

    def logits(self, state: Tensor, action: Tensor, following: Tensor) -> Tensor:
        """Log-odds (N,) that transitions, given as (N, D), (N, A), (N, D), are real."""
        return self.classifier(torch.cat([state, action.to(state), self.bottleneck(following)], dim=-1))[:, 0]

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean binary cross-entropy over all real transitions of the batch and one imposter for each."""
        states = self.encoder.encode(window)
        pairs = states[:, :-1], window.action[:, :-1], states[:, 1:]
        state, action, following = (x.flatten(0, 1) for x in pairs)
        real = window.real[:, 1:].flatten()
        count, real_first = real.sum(), (~real).int().argsort(stable=True)
        # may sample the true next observation: imposters follow p(o') of the batch, which contains it
        imposter = following[real_first[self.draws.integers(count, len(following))]]
        logits = torch.stack([self.logits(state, action, following), self.logits(state, action, imposter)])
        truth = torch.zeros_like(logits)
        truth[0] = 1
        weight, share = real.to(logits), real.float().mean()
        loss = F.binary_cross_entropy_with_logits(logits, truth, weight) / share
        right = (((logits > 0) == (truth > 0)) * weight).mean() / share
        return loss, {"loss": loss.detach(), "accuracy": right}
