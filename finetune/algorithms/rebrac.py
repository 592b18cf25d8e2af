"""ReBRAC: revisiting the minimalist approach to offline reinforcement learning (Tarasov et al. 2023, arXiv 2305.09836).

    critics   y = r + gamma d (min_i Q'_i(z', a~) - beta_2 |a~ - a'|^2),   a~ = pi'(z') + clipped noise
    actor     max  Q_1(z, pi(z)) / mean |Q_1| - beta_1 (pi(z) - a)^2

TD3+BC with a second penalty for leaving the data, in the target; a' is the dataset's action at z'. Critics have three
hidden layers, each followed by LayerNorm. This is the authors' version for V-D4RL's pixels.

Authors' code: github.com/DT6A/ReBRAC (src/algorithms/rebrac_torch_vis.py).

Differences: states are frozen representations, standardised, and go straight into the networks. The authors' actor and
critics each begin with a trunk (Linear, LayerNorm, Tanh); here memoryless encoders end with one. The actor has two
hidden layers, as in every algorithm here (theirs: three). Initial weights are PyTorch's (theirs: orthogonal). n-step
returns are truncated at an episode's end; the authors drop those transitions.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import ClassVar

import torch.nn.functional as F
from torch import Tensor, nn

from finetune.algorithms.algorithm import Loss, ReturnOptions
from finetune.algorithms.td3_bc import TD3BC, TwinCritic
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.nn.heads import ExactLinear
from vd4rl_pomdp.nn.policy import Policy


@dataclass(frozen=True)
class ReBRACOptions(ReturnOptions):
    """Options of ReBRAC; the defaults are the authors' for walker_walk `medium_expert`."""

    actor_bc: float = 0.3
    """ReBRAC's beta_1: weight of behaviour cloning relative to the normalised critic."""
    critic_bc: float = 0.005
    """ReBRAC's beta_2: penalty in the target value on the squared distance between its action and the dataset's."""

    critic_layers: int = 3
    """Hidden layers of each critic."""

    limits: ClassVar[Limits] = {"actor_bc": 0, "critic_bc": 0, "critic_layers": (1, 16)}


def normed_critics(
    dim: int, action_dim: int, hidden: int, layers: int, activation: nn.Module, eps: float
) -> TwinCritic:
    """Q functions with LayerNorm after every hidden layer."""

    def network() -> nn.Sequential:
        modules: list[nn.Module] = []
        for width in [dim + action_dim] + [hidden] * (layers - 1):
            modules += [nn.Linear(width, hidden), activation, nn.LayerNorm(hidden, eps)]
        return nn.Sequential(*modules, ExactLinear(hidden, 1))

    return TwinCritic(network)


class ReBRAC(TD3BC):
    """See the module."""

    options: type[Options] = ReBRACOptions
    summary = "TD3+BC with a behaviour penalty also in the target, and deeper critics with LayerNorm"

    def __init__(
        self, policy: Policy, options: ReBRACOptions, learning_rate: float, updates: int, draws: RandomStream
    ) -> None:
        super().__init__(policy, options, learning_rate, updates, draws)
        # replaces TD3+BC's critics, which are still drawn first so that seeds give the weights of the published rows
        critic = normed_critics(**policy.shape, layers=options.critic_layers, activation=nn.ReLU(), eps=1e-5)
        self.critic = critic.to(policy.standardise.mean.device)
        self.target_critic = copy.deepcopy(self.critic)
        self.critic_optimiser = Adam(self.critic.parameters(), learning_rate, fused=True)

    def _next_value(self, batch: FeatureBatch, next_z: Tensor, chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The smaller value, minus the penalty for leaving the data."""
        value, _ = super()._next_value(batch, next_z, chosen)
        away = (chosen - batch.next_action).square().sum(-1)
        return value - self.settings.critic_bc * away, {"next_bc_loss": away.mean()}

    def actor_loss(self, batch: FeatureBatch, *noise: Tensor) -> Loss:
        z = self.policy.standardise(batch.z.detach())
        chosen = self._policy_action(z, *noise)
        value = self._policy_value(z, chosen)
        cloning = F.mse_loss(chosen, batch.action)
        loss = self.settings.actor_bc * cloning - value.mean() / value.abs().mean().detach()
        return Loss(loss, {"actor_loss": loss.detach(), "bc_loss": cloning.detach()})
