"""Behaviour cloning on frozen representations, as V-D4RL's baseline does it (Lu et al. 2022, arXiv 2206.04779).

    min  (a~ - a)^2,   a~ = pi(z) + clipped noise of a scheduled std

The reference that uses no reward. The noise is that of `drqv2_bc`: noisy actions are cut off at -1 and 1, and the
gradient passes there as if they were not, so that a policy near a bound is pushed outwards while the noise is large: it
is the mean of the actions cut off that comes to be the data's.

Authors' code: github.com/conglu1997/v-d4rl (drqbc/bcagent.py).

Differences:
- Representations go straight into the policy, standardised where the encoder is frozen; the authors' actor begins with
  a trunk (Linear, LayerNorm, Tanh), with which memoryless encoders here end, frozen or not (see `end_to_end`).
- Initial weights are PyTorch's (theirs: orthogonal); V-D4RL's learning rate is 1e-4 (`--learning-rate`).
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor
from torch.optim import Optimizer

from finetune.algorithms.algorithm import Algorithm, Loss
from finetune.algorithms.noise import noise_at, with_noise
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.policy import Policy


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
