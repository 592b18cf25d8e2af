"""Behaviour cloning on frozen representations, as V-D4RL's baseline does it (Lu et al. 2022, arXiv 2206.04779).

    min  (a~ - a)^2,   a~ = pi(z) + clipped noise of a scheduled std

The reference that uses no reward. The noise is that of `drqv2_bc`: noisy actions are cut off at -1 and 1, and the
gradient passes there as if they were not, so that a policy near a bound is pushed outwards while the noise is large: it
is the mean of the actions cut off that comes to be the data's.

Authors' code: github.com/conglu1997/v-d4rl (drqbc/bcagent.py; of the noise drqbc/utils.py, `TruncatedNormal` and
`schedule`).

Differences:
- Representations go straight into the policy, standardised where the encoder is frozen; the authors' actor begins with
  a trunk (Linear, LayerNorm, Tanh), with which memoryless encoders here end, frozen or not (see `end_to_end`).
- Initial weights are PyTorch's (theirs: orthogonal); V-D4RL's learning rate is 1e-4 (`--learning-rate`).
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor
from torch.optim import Optimizer

from finetune.algorithms.algorithm import Algorithm, Loss, share_of
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.policy import Policy

NOISE_CLIP = 0.3
"""Largest noise on a dimension of an action."""
NOISE_START, NOISE_END, NOISE_UPDATES = 1.0, 0.1, 250_000
"""Standard deviation at the first update, from the last of these updates on, and how many these are at most."""
MARGIN = 1e-6
"""How far from -1 and 1 a noisy action stays."""


class BC(Algorithm):
    """See the module."""

    summary = "behaviour cloning, which uses no reward"

    def __init__(
        self, policy: Policy, options: Options, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        self.optimiser = Adam(policy.net.parameters(), learning_rate, fused=True)

    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """One step along the one loss."""
        noise = self.draws.normal(*batch.action.shape) * noise_at(self.updates, self.planned)
        logs = self.minimise(self.cloning_loss, batch, noise, along=(self.optimiser, *encoder))
        self.updates += 1
        return logs

    def cloning_loss(self, batch: FeatureBatch, noise: Tensor) -> Loss:
        """Mean of (a~ - a)^2."""
        chosen = with_noise(self.policy(batch.z), noise)
        loss = F.mse_loss(chosen, batch.action)
        return Loss(loss, {"bc_loss": loss.detach()})


def noise_at(update: int | Tensor, planned: int) -> float | Tensor:
    """Standard deviation of the noise after so many updates: it falls linearly, then stays.

    Args:
        update: updates that were made, see `Algorithm.updates`.
        planned: all that there will be; it falls over half of them where that is sooner than in V-D4RL, which makes
            550,000: noise that has not fallen when training ends pushes the policy's actions outwards.
    """
    done = share_of(update, min(NOISE_UPDATES, planned / 2))
    return NOISE_START + done * (NOISE_END - NOISE_START)


def with_noise(action: Tensor, noise: Tensor) -> Tensor:
    """Copy of (B, A) actions with (B, A) noise, within -1..1; the gradient passes as if nothing had been cut off."""
    noisy = action + noise.clamp(-NOISE_CLIP, NOISE_CLIP)
    # straight through: with the true gradient, 0 beyond the bounds, a saturated action would never come back
    return noisy + (noisy.clamp(MARGIN - 1, 1 - MARGIN) - noisy).detach()
