"""ACDF: multi-step inverse and latent forward models (Levine, Stone & Zhang 2024, arXiv 2403.11940).

    P(a_t | e(o_t), e(o_{t+k})), k in 1..K,   and   ||g(e(o_t), a_t) - sg(e(o_{t+1}))||^2 / D

Multi-step inverse models alone may merge states that differ under control, as where a walk has a period: the two ends
of every pair tell the action all the same. A state that must also predict the next one keeps them apart. The inverse
loss holds the representation: a constant one would be predicted best.

Authors' code: github.com/midi-lab/acdf (grid worlds, on the code of AC-State).

Differences:
- The state is continuous, because TD3+BC needs one, and g regresses the next one. Theirs is one of a number of codes
  (vector quantisation), and g a classifier over them; the proof is for finite states.
- As there, no gradient reaches the encoder by the state that is predicted, and by the one predicted from in every fifth
  update alone (`--forward-every`); both losses weigh 1 (`--forward-weight`).
- g has three hidden layers of 512, theirs of 1024; theirs are leaky.
- All pairs of a window are scored at once, and every (t, t+1) of it predicted; theirs draws one k for each transition.
- Continuous actions: the inverse model's target is a choice, and g is given a_t itself; theirs are one of a few.
- A window shares one random shift, since g could not foresee that of the next row; the authors do not augment.
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
    """Updates of which one lets the forward loss's gradient into the encoder."""

    limits: ClassVar[Limits] = {"forward_weight": 0, "forward_every": 1}


class ACDF(LatentForward):
    """ACRO's inverse model, and a forward model on its states."""

    updates: Tensor

    def __init__(self, encoder: Encoder, target: ActionTarget, options: ACDFOptions, seed: int) -> None:
        super().__init__(encoder, target, options, seed)
        self.forward_every = options.forward_every
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    def forward_ends(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """The target takes no gradient, what is predicted from in one of `forward_every` updates."""
        # a gate of 0 or 1, not a branch: a step that is replayed does the same in every update
        gate = (self.updates % self.forward_every == 0).to(states)
        now, following = states[:, :-1], states[:, 1:].detach()
        return now.detach() + gate * (now - now.detach()), following

    def after_step(self) -> None:
        """Count the update."""
        self.updates += 1
