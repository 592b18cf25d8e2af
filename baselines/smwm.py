"""SMWM: sensorimotor world models (Ivashkov, Balestriero & Schoelkopf 2026, arXiv 2606.20104): one-step inverse and
latent forward models, trained together.

    L = ||g(e(o_t), a_t) - e(o_{t+1})||^2 / D + lambda ||h(e(o_t), e(o_{t+1})) - a_t||^2 / A

Both ends of the forward loss take its gradient: there is no stop-gradient, no momentum encoder and no regulariser of
the states' distribution. The inverse model alone keeps the representation from collapse.

Authors' code: github.com/petr-ivashkov/sensorimotor-world-model.

Differences:
- The encoder is that of all methods here. Theirs is a ViT (tiny, on 224 pixels, one frame a state) with a batch norm in
  the projection of its output to 192 numbers; here layer norm and tanh bound the states.
- g is an MLP with three hidden layers of 512; theirs is a transformer of six layers whose norms the action modulates.
- The inverse model has two hidden layers of 256, as theirs. Its target is a choice: K-means codes by default as in all
  inverse models here, `--action-target mse` for theirs, on actions as stored (theirs are standardised).
- `--forward-weight` weighs the forward loss, and so is their 1 / lambda (1 by default); Adam 3e-4, theirs AdamW 1e-4.
- An observation here is a stack of frames, so that velocities are seen; theirs is one frame.
- A window shares one random shift, since g could not foresee that of the next row; the authors do not augment.
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
    """An inverse model on consecutive states, and a forward model between them."""

    def forward_ends(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Both take the gradient."""
        return states[:, :-1], states[:, 1:]
