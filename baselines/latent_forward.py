"""Base class of inverse models with a latent forward model: ACDF and SMWM."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.nn.objective import StateInverse


class LatentForward(StateInverse):
    """An inverse model with a forward loss on its states: ||g(s_t, a_t) - s_{t+1}||^2 / D."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: Any, seed: int) -> None:
        """Initialise; `options` are `ActionOptions` with a field `forward_weight`."""
        super().__init__(encoder, target, options, seed)
        self.forward_weight: float = options.forward_weight
        self.forward_model = mlp(encoder.dim + encoder.config.action_dim, 512, encoder.dim, layers=3)

    @abstractmethod
    def forward_ends(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Input and target of the forward model, each (B, T - 1, D), from states (B, T, D); detached where needed."""

    def loss_of(
        self, past: Tensor, future: Tensor, window: Windows, progress: float | Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The inverse model's loss plus the weighted `forward_loss` over all real transitions (t, t + 1)."""
        loss, logs = super().loss_of(past, future, window, progress)
        now, following = self.forward_ends(past)
        predicted = self.forward_model(torch.cat([now, window.action[:, :-1].to(now)], dim=-1))
        error, real = (predicted - following).square().mean(-1), window.real[:, 1:]
        forward_loss = (error * real).sum() / real.sum()
        loss = loss + self.forward_weight * forward_loss
        return loss, logs | {"forward_loss": forward_loss.detach(), "loss": loss.detach()}
