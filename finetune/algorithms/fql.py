"""FQL: flow Q-learning (Park et al. 2025, arXiv 2502.02538).

    critics   y = r + gamma d mean_i Q'_i(z', mu(z', e)),   e ~ N(0, I)
    flow      min  (v(z, x_t, t) - (a - x_0))^2,   x_t = (1 - t) x_0 + t a,   x_0 ~ N(0, I),   t ~ U(0, 1)
    policy    max  lambda mean_i Q_i(z, mu(z, e)) - alpha (mu(z, e) - flow(z, e))^2,   lambda = 1 / mean |Q|

A flow clones the behaviour policy and can be multimodal: its velocity v transports noise e at time 0 to an action at
time 1, in ten Euler steps. A one-step policy mu is distilled from it, which avoids backpropagation through the steps,
and also maximises Q. All networks are trained by one summed loss, each against the others' weights from before the
update.

The saved policy is mu(z, 0), the action at the noise's mode, since evaluation here is deterministic. Its network is
mu's without the noise, which enters the first hidden layer through separate weights (`NoiseIn`).

Authors' code: github.com/seohongpark/fql (agents/fql.py).

Differences: states are frozen representations, standardised; returns are n-step. mu is the policy network of all
algorithms here: two ReLU layers and tanh (theirs: four GELU layers, clipped to [-1, 1]). They act with fresh noise at
every step. lambda follows the authors' recommendation for new tasks (the paper's runs used 1). Initial weights are
PyTorch's (theirs: Glorot, zero biases).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call
from torch.optim import Optimizer

from finetune.algorithms.algorithm import Algorithm, Loss, ReturnOptions
from finetune.algorithms.rebrac import normed_critics
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.heads import ExactLinear, move_target
from vd4rl_pomdp.nn.policy import Policy

LAYERS = 4
"""Hidden layers of the flow and of each critic."""
STEPS = 10
"""Euler steps from noise to an action."""


@dataclass(frozen=True)
class FQLOptions(ReturnOptions):
    """Options of FQL."""

    distillation: float = 1.0
    """FQL's alpha: weight of the one-step policy's distance from the flow, relative to the critics."""
    normalise_q: bool = True
    """Divide the policy's objective by the mean |Q|, so that --distillation suits rewards of any scale."""

    limits: ClassVar[Limits] = {"distillation": 0}


class Flow(nn.Module):
    """Velocity field over actions: (B, D), (B, A), (B, 1) -> (B, A)."""

    def __init__(self, dim: int, action_dim: int, hidden: int) -> None:
        super().__init__()
        self.state = nn.Linear(dim, hidden)
        self.moving = nn.Linear(action_dim + 1, hidden, bias=False)
        deeper = [layer for _ in range(LAYERS - 1) for layer in (nn.Linear(hidden, hidden), _gelu())]
        self.rest = nn.Sequential(_gelu(), *deeper, ExactLinear(hidden, action_dim))

    def forward(self, z: Tensor, x: Tensor, t: Tensor) -> Tensor:
        return self._velocity(self.state(z), x, t)

    def act(self, z: Tensor, noise: Tensor) -> Tensor:
        """Transport (B, A) noise to actions (B, A) in [-1, 1]."""
        state, x = self.state(z), noise  # the state's contribution to the first layer is the same in all steps
        for step in range(STEPS):
            x = x + self._velocity(state, x, torch.full_like(x[:, :1], step / STEPS)) / STEPS
        return x.clamp(-1, 1)

    def _velocity(self, state: Tensor, x: Tensor, t: Tensor) -> Tensor:
        return self.rest(state + self.moving(torch.cat([x, t], dim=-1)))


class NoiseIn(nn.Linear):
    """Contribution of noise to a policy's first hidden layer: 0 at zero noise, where the policy is mu(z, 0)."""

    def __init__(self, action_dim: int, hidden: int) -> None:
        super().__init__(action_dim, hidden, bias=False)

    def act(self, policy: Policy, z: Tensor, noise: Tensor) -> Tensor:
        """Actions (B, A) of a policy for standardised (B, D), at (B, A) noise."""
        first, *rest = policy.net
        hidden = first(z) + self(noise)
        for layer in rest:
            hidden = layer(hidden)
        return torch.tanh(hidden)


class FQL(Algorithm):
    """See the module."""

    options: type[Options] = FQLOptions
    summary = "flow Q-learning: a flow clones the data; a one-step policy distilled from it maximises value"
    tau = 0.005

    def __init__(
        self, policy: Policy, options: FQLOptions, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        device, shape = policy.standardise.mean.device, policy.shape
        self.noise_in = NoiseIn(shape["action_dim"], shape["hidden"]).to(device)
        self.flow = Flow(**shape).to(device)
        self.critic = normed_critics(**shape, layers=LAYERS, activation=_gelu(), eps=1e-6).to(device)
        self.target_critic = copy.deepcopy(self.critic)
        learnt = (policy.net, self.noise_in, self.flow, self.critic)
        self.optimiser = Adam([p for module in learnt for p in module.parameters()], learning_rate, fused=True)

    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        shape = batch.action.shape
        next_noise, start, noise = (self.draws.normal(*shape) for _ in range(3))
        time = self.draws.uniform(*shape[:-1], 1)
        logs = self.minimise(self.loss, batch, next_noise, start, time, noise, along=(self.optimiser, *encoder))
        move_target(self.target_critic, self.critic, self.tau)
        self.updates += 1
        return logs

    def loss(self, batch: FeatureBatch, next_noise: Tensor, start: Tensor, time: Tensor, noise: Tensor) -> Loss:
        """Sum of three losses, each of which treats the other two's networks as constants.

        The flow is cloned from `start` (B, A), at times (B, 1); the other noise (B, A) is that of the actions.
        """
        critic, policy = self.critic_loss(batch, next_noise), self.policy_loss(batch, noise)
        flow = self.flow_loss(batch, start, time)
        return Loss(critic.value + flow.value + policy.value, critic.logs | flow.logs | policy.logs)

    def critic_loss(self, batch: FeatureBatch, noise: Tensor) -> Loss:
        z, next_z = self.policy.standardise(batch.z), self.policy.standardise(batch.next_z)
        with torch.no_grad():
            value = _mean(self.target_critic(next_z, self.noise_in.act(self.policy, next_z, noise)))
            target = batch.reward + self.settings.gamma * batch.discount * value
        first, second = self.critic(z, batch.action)
        loss = (F.mse_loss(first, target) + F.mse_loss(second, target)) / 2
        return Loss(loss, {"critic_loss": loss.detach(), "q": first.detach().mean()})

    def flow_loss(self, batch: FeatureBatch, start: Tensor, time: Tensor) -> Loss:
        """Squared error of the velocity on the straight line from noise to the data's action."""
        z = self.policy.standardise(batch.z.detach())  # an encoder is trained by the critics' loss only
        velocity = self.flow(z, torch.lerp(start, batch.action, time), time)
        loss = F.mse_loss(velocity, batch.action - start)
        return Loss(loss, {"flow_loss": loss.detach()})

    def policy_loss(self, batch: FeatureBatch, noise: Tensor) -> Loss:
        """Distance from the flow's actions, minus the value."""
        z = self.policy.standardise(batch.z.detach())
        with torch.no_grad():
            cloned = self.flow.act(z, noise)
        chosen = self.noise_in.act(self.policy, z, noise)
        distance = F.mse_loss(chosen, cloned)
        # constant weights: this loss must not train the critics to overrate the policy's actions
        frozen = {name: weight.detach() for name, weight in self.critic.named_parameters()}
        value = _mean(functional_call(self.critic, frozen, (z, chosen)))
        size = value.abs().mean().detach() if self.settings.normalise_q else 1.0
        loss = self.settings.distillation * distance - value.mean() / size
        with torch.no_grad():
            cloning = F.mse_loss(chosen, batch.action)
        return Loss(loss, {"actor_loss": loss.detach(), "distillation_loss": distance.detach(), "bc_loss": cloning})


def _gelu() -> nn.GELU:
    return nn.GELU(approximate="tanh")  # JAX's default


def _mean(both: tuple[Tensor, Tensor]) -> Tensor:
    return (both[0] + both[1]) / 2
