"""ACDF: multi-step inverse and latent forward models (Levine, Stone & Zhang 2024, arXiv 2403.11940).

    P(a_t | e(o_t), e(o_{t+k})), k in 1..K,   and   ||g(e(o_t), a_t) - sg(e(o_{t+1}))||^2 / D

A multi-step inverse model alone may merge states that differ under control, for example in periodic dynamics, where a
pair's two ends still determine the action. Requiring that a state also predicts the next one separates them. The
inverse loss in turn prevents collapse: a constant representation would have zero forward loss.

Authors' code: github.com/midi-lab/acdf (grid worlds, on the code of AC-State).

Differences:
- The state is continuous, because TD3+BC needs that, and g regresses the next state. Theirs is discrete (vector
  quantisation) and g a classifier over the codes; their proof is for finite states.
- As in their code, the forward loss sends no gradient into its target, and into its input only in every fifth update
  (`--forward-every`). Both losses have weight 1 (`--forward-weight`).
- g has three hidden layers of 512 with ReLU; theirs has 1024 with leaky ReLU.
- All pairs of a window, and all its transitions (t, t+1), are used at once; theirs samples one k per transition.
- Actions are continuous: the inverse model's target is configurable, and g reads a_t itself; theirs are discrete.
- A window shares one random shift, since g could not predict the shift of the next row; the authors do not augment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from baselines.latent_forward import LatentForward
from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.objective import InverseOptions


@dataclass(frozen=True)
class ACDFOptions(InverseOptions):
    """Options of `acdf`."""

    forward_weight: float = 1.0
    """Weight of the latent forward model's loss."""
    forward_every: int = 5
    """The forward loss updates the encoder only in every n-th gradient step."""

    limits: ClassVar[Limits] = {"forward_weight": 0, "forward_every": 1}


class ACDF(LatentForward):
    """ACRO's inverse model plus a forward model on its states."""

    updates: Tensor

    def __init__(self, encoder: Encoder, target: ActionTarget, options: ACDFOptions, seed: int) -> None:
        super().__init__(encoder, target, options, seed)
        self.forward_every = options.forward_every
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    def forward_ends(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """No gradient to the target; gradient to the input in one of `forward_every` updates."""
        # a gate of 0 or 1 instead of an `if`, which a captured CUDA graph would freeze
        gate = (self.updates % self.forward_every == 0).to(states)
        now, following = states[:, :-1], states[:, 1:].detach()
        return now.detach() + gate * (now - now.detach()), following

    def after_step(self) -> None:
        self.updates += 1
