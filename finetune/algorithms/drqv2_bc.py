"""DrQ-v2+BC: the update rule of V-D4RL's baseline (Lu et al. 2022, arXiv 2206.04779), on frozen representations.

    critics   y = r + gamma d min_i Q'_i(z', a'),   a' = pi(z') + clipped noise of a scheduled std
    actor     max  lambda min_i Q_i(z, a~) - (a~ - a)^2,   a~ = pi(z) + the same noise, lambda = alpha / mean |Q|

Authors' code: github.com/conglu1997/v-d4rl (drqbc).

Differences to TD3+BC here: no target actor, an actor step with every critic step, noise that decays linearly from 1.0
to 0.1 over 250k updates, tau 0.01. Differences to the authors' loop: the encoder is frozen, so there is no trunk
and no encoder update; V-D4RL's learning rate is 1e-4 (`--learning-rate`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from finetune.algorithms.td3_bc import TD3BC

NOISE_CLIP = 0.3
NOISE_START, NOISE_END, NOISE_UPDATES = 1.0, 0.1, 250_000


class DrQv2BC(TD3BC):
    """See the module."""

    summary = "the update of V-D4RL's baseline: no target actor, scheduled noise"
    tau = 0.01
    policy_delay = 1

    @property
    def noise(self) -> float:
        """Standard deviation of the noise at this update."""
        done = min(1.0, self.updates / NOISE_UPDATES)
        return NOISE_START + done * (NOISE_END - NOISE_START)

    def _next_action(self, next_z: Tensor) -> Tensor:
        return self._noisy(self.policy.from_standardised(next_z), self.noise, NOISE_CLIP)

    def _policy_action(self, z: Tensor) -> Tensor:
        return self._noisy(self.policy.from_standardised(z), self.noise, NOISE_CLIP)

    def _policy_value(self, z: Tensor, action: Tensor) -> Tensor:
        return torch.minimum(*self.critic(z, action))
