"""SMWM: sensorimotor world models (Ivashkov, Balestriero & Schoelkopf 2026, arXiv 2606.20104): one-step inverse and
latent forward models, trained together.

    L = ||g(e(o_t), a_t) - e(o_{t+1})||^2 / D + lambda ||h(e(o_t), e(o_{t+1})) - a_t||^2 / A

The forward loss sends gradients into both its input and its target: no stop-gradient, no momentum encoder, and no
regulariser on the distribution of states. Only the inverse model prevents the representation from collapsing.

Authors' code: github.com/petr-ivashkov/sensorimotor-world-model.

Differences:
- The encoder is the one used by all methods here, whose states layer norm and tanh bound. Theirs is a ViT-Tiny on one
  224-pixel frame, with a batch norm in the projection of its output to 192 dimensions.
- g is an MLP with three hidden layers of 512; theirs is a 6-layer transformer with action-conditioned norm layers.
- The inverse model has two hidden layers of 256, as theirs. Its target is configurable: K-means codes by default, as in
  all inverse models here; `--action-target mse` is theirs, on raw actions (theirs are standardised).
- `--forward-weight` multiplies the forward loss, so it equals their 1 / lambda (default 1). Adam with 3e-4; theirs is
  AdamW with 1e-4.
- An observation is a stack of frames, which shows velocities; theirs is one frame.
- A window shares one random shift, since g could not predict the shift of the next row; the authors do not augment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from baselines.latent_forward import LatentForward
from vd4rl_pomdp.core.options import Limits
from vd4rl_pomdp.nn.objective import ActionOptions


@dataclass(frozen=True)
class SMWMOptions(ActionOptions):
    """Options of `smwm`."""

    forward_weight: float = 1.0
    """Weight of the latent forward model's loss."""

    limits: ClassVar[Limits] = {"forward_weight": 0}


class SMWM(LatentForward):
    """An inverse model on consecutive states plus a forward model between them."""

    def forward_ends(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing is detached: gradients flow to both."""
        return states[:, :-1], states[:, 1:]
