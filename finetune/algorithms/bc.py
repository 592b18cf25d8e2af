"""Behaviour cloning on frozen representations, as in V-D4RL's baseline (Lu et al. 2022, arXiv 2206.04779).

    min  (a~ - a)^2,   a~ = pi(z) + clipped noise of a scheduled std

The baseline that ignores rewards. The noise is that of `drqv2_bc`: noisy actions are clipped to [-1, 1] with a
straight-through gradient. So while the noise is large, a policy near a bound is pushed outwards, because it is the mean
of the clipped actions that matches the data.

Authors' code: github.com/conglu1997/v-d4rl (drqbc/bcagent.py; noise: drqbc/utils.py, `TruncatedNormal` and `schedule`).

Differences:
- Representations go straight into the policy, standardised if the encoder is frozen. The authors' actor begins with a
  trunk (Linear, LayerNorm, Tanh); here memoryless encoders end with one, frozen or not (see `end_to_end`).
- Initial weights are PyTorch's (theirs: orthogonal).
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
"""Maximum absolute noise per action dimension."""
NOISE_START, NOISE_END, NOISE_UPDATES = 1.0, 0.1, 125_000
"""Initial and final standard deviation of the noise, and the maximum number of updates over which it decays: V-D4RL's
250,000 steps, of which every second one is an update."""
MARGIN = 1e-6
"""Minimum distance of a noisy action from -1 and 1."""


class BC(Algorithm):
    """See the module."""

    summary = "behaviour cloning, without rewards"

    def __init__(
        self, policy: Policy, options: Options, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        self.optimiser = Adam(policy.net.parameters(), learning_rate, fused=True)

    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        noise = self.draws.normal(*batch.action.shape) * noise_at(self.updates, self.planned)
        logs = self.minimise(self.cloning_loss, batch, noise, along=(self.optimiser, *encoder))
        self.updates += 1
        return logs

    def cloning_loss(self, batch: FeatureBatch, noise: Tensor) -> Loss:
        chosen = with_noise(self.policy(batch.z), noise)
        loss = F.mse_loss(chosen, batch.action)
        return Loss(loss, {"bc_loss": loss.detach()})


def noise_at(update: int | Tensor, planned: int) -> float | Tensor:
    """Standard deviation of the noise after some of the planned updates: decays linearly, then stays constant.

    It decays over half of them if that is sooner than in V-D4RL, which trains for 550,000 updates: noise that is still
    large at the end of training leaves the policy's actions pushed outwards.
    """
    done = share_of(update, min(NOISE_UPDATES, planned / 2))
    return NOISE_START + done * (NOISE_END - NOISE_START)


def with_noise(action: Tensor, noise: Tensor) -> Tensor:
    """(B, A) actions plus (B, A) noise, clipped to [-1, 1] with a straight-through gradient."""
    noisy = action + noise.clamp(-NOISE_CLIP, NOISE_CLIP)
    # the true gradient is 0 beyond the bounds, so saturated actions could never recover
    return noisy + (noisy.clamp(MARGIN - 1, 1 - MARGIN) - noisy).detach()
