"""IQL: offline reinforcement learning with implicit Q-learning (Kostrikov et al. 2021, arXiv 2110.06169).

    critics   y = r + gamma d V(z')
    value     min  |expectile - 1(u < 0)| u^2,   u = min_i Q'_i(z, a) - V(z)
    actor     max  min(exp(temperature u), 100) log pi(a | z)

Q is never evaluated at actions outside the data: V is an expectile over the data's actions, and the actor clones the
better ones. pi is a Gaussian around the policy's action with one learnt standard deviation per action dimension; the
saved policy is its mean. The actor's learning rate follows a cosine to 0.

Authors' code: github.com/ikostrikov/implicit_q_learning, in its locomotion setting.

Differences: states are frozen representations, standardised; returns are n-step. The critics step first, because an
encoder is trained by the first loss: the authors' cycle (value, actor, critics, targets) starts at the critics, so
V(z') has only learnt from earlier batches. Rewards are not scaled: the authors scale locomotion rewards so that a
dataset's returns span 1000. The trained actors' datasets here span 88 (cheetah_run `expert`) to 946 (walker_walk
`medium_expert`), so scaling would multiply the temperature by 11 to 1. Initial weights are PyTorch's (theirs:
orthogonal).
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim import Optimizer

from finetune.algorithms.algorithm import Algorithm, Loss, ReturnOptions, share_of
from finetune.algorithms.td3_bc import TwinCritic
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam, set_learning_rate
from vd4rl_pomdp.nn.heads import ExactLinear, mlp, move_target
from vd4rl_pomdp.nn.policy import Policy

MOST_WEIGHT = 100.0
LOG_STD_RANGE = -5.0, 2.0


@dataclass(frozen=True)
class IQLOptions(ReturnOptions):
    """Options of IQL."""

    expectile: float = 0.7
    """IQL's expectile, from 0 to 1: at 0.5 V is the mean over actions; larger values favour the best actions."""
    temperature: float = 3.0
    """IQL's inverse temperature beta: actions are cloned with weight exp(beta * advantage)."""

    limits: ClassVar[Limits] = {"expectile": (0, 1), "temperature": 0}


class Gaussian(nn.Module):
    """Gaussian around an action, with learnt, state-independent standard deviations."""

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, mean: Tensor, action: Tensor) -> Tensor:
        """Log-likelihoods of actions: (B, A), (B, A) -> (B,)."""
        std = self.log_std.clamp(*LOG_STD_RANGE).exp()
        # validation reads values, which would sync the GPU in every update
        return torch.distributions.Normal(mean, std, validate_args=False).log_prob(action).sum(-1)


class IQL(Algorithm):
    """See the module."""

    options: type[Options] = IQLOptions
    summary = "implicit Q-learning: expectile values of the data's actions, advantage-weighted cloning"
    tau = 0.005

    def __init__(
        self, policy: Policy, options: IQLOptions, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        dim, action_dim, hidden = (policy.shape[name] for name in ("dim", "action_dim", "hidden"))
        device = policy.standardise.mean.device
        self.critic = TwinCritic(lambda: mlp(dim + action_dim, hidden, 1, last=ExactLinear)).to(device)
        self.target_critic = copy.deepcopy(self.critic)
        self.value = mlp(dim, hidden, 1, last=ExactLinear).to(device)
        self.gaussian = Gaussian(action_dim).to(device)
        actor = [*policy.net.parameters(), *self.gaussian.parameters()]
        self.policy_optimiser = Adam(actor, learning_rate, fused=True)
        self.critic_optimiser = Adam(self.critic.parameters(), learning_rate, fused=True)
        self.value_optimiser = Adam(self.value.parameters(), learning_rate, fused=True)

    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """One step of the critics and their targets, then of the value, then of the actor."""
        critic = self.minimise(self.critic_loss, batch, along=(self.critic_optimiser, *encoder))
        move_target(self.target_critic, self.critic, self.tau)
        q = self.each(self.target_value, batch)  # once, for both losses
        value = self.minimise(self.value_loss, batch, q, along=(self.value_optimiser,))
        set_learning_rate(self.policy_optimiser, self.policy_learning_rate)
        actor = self.minimise(self.actor_loss, batch, q, along=(self.policy_optimiser,))
        self.updates += 1
        return critic | value | actor

    @torch.no_grad()
    def target_value(self, batch: FeatureBatch) -> Tensor:
        """Smaller target value (B,) of the data's actions."""
        return torch.minimum(*self.target_critic(self.policy.standardise(batch.z), batch.action))

    def critic_loss(self, batch: FeatureBatch) -> Loss:
        z, next_z = self.policy.standardise(batch.z), self.policy.standardise(batch.next_z)
        with torch.no_grad():
            # V(z') instead of Q at the policy's action: no action outside the data is evaluated
            target = batch.reward + self.settings.gamma * batch.discount * self.value(next_z)[:, 0]
        return self.critic.loss(z, batch.action, target)

    def value_loss(self, batch: FeatureBatch, q: Tensor) -> Loss:
        """Expectile loss of V to the (B,) smaller target value of the data's actions."""
        value = self.value(self.policy.standardise(batch.z.detach()))[:, 0]
        loss = expectile_loss(q - value, self.settings.expectile)
        return Loss(loss, {"value_loss": loss.detach(), "v": value.detach().mean()})

    def actor_loss(self, batch: FeatureBatch, q: Tensor) -> Loss:
        """Negative log-likelihood of the data's actions, weighted by exponentiated advantage."""
        z, action = self.policy.standardise(batch.z.detach()), batch.action
        with torch.no_grad():
            advantage = q - self.value(z)[:, 0]
            # clipped, or one transition underrated by an untrained V would dominate the gradient
            weight = (self.settings.temperature * advantage).exp().clamp(max=MOST_WEIGHT)
        chosen = self.policy.from_standardised(z)
        loss = -(weight * self.gaussian(chosen, action)).mean()
        logs = {"actor_loss": loss.detach(), "advantage": advantage.mean(), "weight": weight.mean()}
        return Loss(loss, logs | {"bc_loss": F.mse_loss(chosen.detach(), action)})

    @property
    def policy_learning_rate(self) -> float | Tensor:
        done = share_of(self.updates, self.planned)
        cosine = torch.cos(math.pi * done) if isinstance(done, Tensor) else math.cos(math.pi * done)
        return self.learning_rate * (1 + cosine) / 2


def expectile_loss(error: Tensor, expectile: float) -> Tensor:
    """Mean of |expectile - 1(u < 0)| u^2 over errors u: (B,) -> scalar. At 0.5, half the mean squared error."""
    return ((expectile - (error < 0).float()).abs() * error.square()).mean()
