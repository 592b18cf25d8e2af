"""DrQ-v2+BC: the update rule of V-D4RL's baseline (Lu et al. 2022, arXiv 2206.04779), on frozen representations.

    critics   y = r + gamma d min_i Q'_i(z', a'),   a' = pi(z') + clipped noise of a scheduled std
    actor     max  lambda min_i Q_i(z, a~) - (a~ - a)^2,   a~ = pi(z) + the same noise, lambda = alpha / mean |Q|

Noisy actions are clipped to [-1, 1] with a straight-through gradient.

Authors' code: github.com/conglu1997/v-d4rl (drqbc).

Differences from TD3+BC here: no target actor; an actor step with every critic step; noise that decays linearly from 1.0
to 0.1 over 125k updates (or half of a shorter training) and is also added to the cloned action; tau 0.01.

Differences from the authors' training loop:
- Representations go straight into the networks, standardised if the encoder is frozen. The authors' actor and critic
  each begin with their own trunk (Linear, LayerNorm, Tanh) on the convolutions' output, and the target critic's trunk
  is averaged like the rest of it. Here memoryless encoders end with such a layer, shared by all, frozen or not (see
  `end_to_end`).
- Initial weights are PyTorch's (theirs: orthogonal).
- n-step returns are truncated at an episode's end; the authors drop those transitions.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from finetune.algorithms.bc import noise_at, with_noise
from finetune.algorithms.td3_bc import TD3BC
from finetune.features import FeatureBatch


class DrQv2BC(TD3BC):
    """See the module."""

    summary = "the update of V-D4RL's baseline: no target actor, scheduled noise"
    tau = 0.01
    period = 1

    def next_noise(self, batch: FeatureBatch) -> Tensor:
        """Scheduled noise for the next actions; `actor_noise` is distributed the same."""
        return self.draws.normal(*batch.action.shape) * noise_at(self.updates, self.planned)

    def actor_noise(self, batch: FeatureBatch) -> Sequence[Tensor]:
        return (self.next_noise(batch),)

    def _next_action(self, next_z: Tensor, noise: Tensor) -> Tensor:
        return self._policy_action(next_z, noise)

    def _policy_action(self, z: Tensor, *noise: Tensor) -> Tensor:
        return with_noise(self.policy.from_standardised(z), *noise)

    def _policy_value(self, z: Tensor, action: Tensor) -> Tensor:
        return torch.minimum(*self.critic(z, action))
