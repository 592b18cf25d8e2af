"""TD3+BC: a minimalist approach to offline reinforcement learning (Fujimoto & Gu 2021, arXiv 2106.06860).

    critics   y = r + gamma d min_i Q'_i(z', pi'(z') + clipped noise)
    actor     max  lambda Q_1(z, pi(z)) - (pi(z) - a)^2,   lambda = alpha / mean |Q_1|

Authors' code: github.com/sfujim/TD3_BC.

Differences: states are frozen representations, standardised like the authors' states; returns are n-step.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim import Optimizer

from finetune.algorithms.algorithm import Algorithm, Loss, ReturnOptions
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.heads import ExactLinear, mlp, move_target
from vd4rl_pomdp.nn.policy import Policy

TARGET_NOISE, NOISE_CLIP = 0.2, 0.5


@dataclass(frozen=True)
class TD3BCOptions(ReturnOptions):
    """Options of TD3+BC."""

    alpha: float = 2.5
    """Weight of the critic relative to behaviour cloning."""

    limits: ClassVar[Limits] = {"alpha": 0}


class TwinCritic(nn.Module):
    """Two independent Q functions: (B, D), (B, A) -> two (B,); each is a new network (B, D + A) -> (B, 1)."""

    def __init__(self, network: Callable[[], nn.Sequential]) -> None:
        super().__init__()
        self.first, self.second = network(), network()

    def forward(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        both = torch.cat([z, action], dim=-1)
        return self.first(both)[:, 0], self.second(both)[:, 0]

    def loss(self, z: Tensor, action: Tensor, target: Tensor) -> Loss:
        """Sum of both critics' mean squared errors to one (B,) target. Logs the first critic's mean value as `q`."""
        first, second = self(z, action)
        loss = F.mse_loss(first, target) + F.mse_loss(second, target)
        return Loss(loss, {"critic_loss": loss.detach(), "q": first.detach().mean()})


class TD3BC(Algorithm):
    """See the module."""

    options: type[Options] = TD3BCOptions
    summary = "TD3 with a behaviour cloning term"
    tau = 0.005
    period = 2
    """Critic updates per actor update."""

    def __init__(
        self, policy: Policy, options: ReturnOptions, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        inputs, hidden = policy.shape["dim"] + policy.shape["action_dim"], policy.shape["hidden"]
        self.critic = TwinCritic(lambda: mlp(inputs, hidden, 1, last=ExactLinear)).to(policy.standardise.mean.device)
        self.target_policy, self.target_critic = copy.deepcopy(policy), copy.deepcopy(self.critic)
        self.policy_optimiser = Adam(policy.net.parameters(), learning_rate, fused=True)
        self.critic_optimiser = Adam(self.critic.parameters(), learning_rate, fused=True)

    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """One step of the critics; in the last update of a `period`, also of the actor and the targets."""
        optimisers = (self.critic_optimiser, *encoder)
        logs = self.minimise(self.critic_loss, batch, self.next_noise(batch), along=optimisers)
        if self.turn == self.period - 1:
            drawn = self.actor_noise(batch)
            logs |= self.minimise(self.actor_loss, batch, *drawn, along=(self.policy_optimiser,))
            self.move_targets()
        self.updates += 1  # last: DrQ-v2's noise schedule uses the number of previous updates for both losses
        return logs

    def next_noise(self, batch: FeatureBatch) -> Tensor:
        """Target policy smoothing: noise on the next actions averages out narrow peaks of the critic."""
        return (self.draws.normal(*batch.action.shape) * TARGET_NOISE).clamp(-NOISE_CLIP, NOISE_CLIP)

    def actor_noise(self, batch: FeatureBatch) -> Sequence[Tensor]:
        return ()

    def critic_loss(self, batch: FeatureBatch, noise: Tensor) -> Loss:
        z, next_z = self.policy.standardise(batch.z), self.policy.standardise(batch.next_z)
        with torch.no_grad():
            value, logs = self._next_value(batch, next_z, self._next_action(next_z, noise))
            # `discount` is 0 if the task ended within the n steps; time limits still bootstrap
            target = batch.reward + self.settings.gamma * batch.discount * value
        loss = self.critic.loss(z, batch.action, target)
        return Loss(loss.value, loss.logs | logs)

    def actor_loss(self, batch: FeatureBatch, *noise: Tensor) -> Loss:
        z = self.policy.standardise(batch.z.detach())  # an encoder is trained by the critics' loss only
        chosen = self._policy_action(z, *noise)
        value = self._policy_value(z, chosen)
        # normalising lets one alpha fit any reward scale; detached, or the actor could shrink |Q| instead
        weight = self.settings.alpha / value.abs().mean().detach()
        cloning = F.mse_loss(chosen, batch.action)
        loss = cloning - weight * value.mean()
        return Loss(loss, {"actor_loss": loss.detach(), "bc_loss": cloning.detach()})

    def _next_value(self, batch: FeatureBatch, next_z: Tensor, chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Bootstrap value (B,) of the next actions (B, A), and scalars to log."""
        # minimum of two critics, since the policy exploits overestimation that no new data corrects
        return torch.minimum(*self.target_critic(next_z, chosen)), {}

    def _next_action(self, next_z: Tensor, noise: Tensor) -> Tensor:
        return (self.target_policy.from_standardised(next_z) + noise).clamp(-1, 1)

    def _policy_value(self, z: Tensor, action: Tensor) -> Tensor:
        return self.critic.first(torch.cat([z, action], dim=-1))

    def _policy_action(self, z: Tensor, *noise: Tensor) -> Tensor:
        return self.policy.from_standardised(z)

    def move_targets(self) -> None:
        move_target(self.target_critic, self.critic, self.tau)
        move_target(self.target_policy.net, self.policy.net, self.tau)
