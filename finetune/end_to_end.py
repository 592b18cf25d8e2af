"""End-to-end baselines, as in V-D4RL: the encoder is trained by the algorithm's own loss instead of being frozen.

`bc` trains it by behaviour cloning, `drq_bc` by the critic's loss (Lu et al. 2022, arXiv 2206.04779): the actor's
gradient stops at the representation.

Authors' code: github.com/conglu1997/v-d4rl (drqbc).

Differences: actor, critic and target critic share the encoder's last layer (Linear, LayerNorm, Tanh). In V-D4RL each
has its own such trunk on the convolutions: the actor's is trained by the actor's loss, and the target critic's is
averaged like the rest of the target. Here the layer is trained by the critic's loss only, and targets use its current
weights. For `bc`, with its single loss, this makes no difference. Initial weights are PyTorch's (theirs: orthogonal).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from finetune.algorithms import Algorithm
from finetune.config import FinetuneConfig
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.hardware import autocast
from vd4rl_pomdp.core.types import Transitions
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.encoder import Encoder


class EndToEnd:
    """An algorithm together with the encoder that its first loss trains."""

    def __init__(self, algorithm: Algorithm, encoder: Encoder, config: FinetuneConfig) -> None:
        self.algorithm, self.encoder, self.config = algorithm, encoder.train().requires_grad_(True), config
        self.policy = algorithm.policy
        self.optimiser = Adam(encoder.parameters(), config.learning_rate)

    def update(self, batch: Transitions) -> dict[str, Tensor]:
        device = batch.obs.device
        with autocast(device, self.config.precision):
            z = self.encoder.frame(batch.obs).float()
            with torch.no_grad():  # targets: V-D4RL has no target encoder either
                next_z = self.encoder.frame(batch.next_obs).float()
        features = FeatureBatch(z, batch.action, batch.reward, batch.discount, next_z, batch.next_action)
        return self.algorithm.update(features, self.optimiser)

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name).state_dict() for name in ("algorithm", "encoder", "optimiser")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, own in state.items():
            getattr(self, name).load_state_dict(own)
