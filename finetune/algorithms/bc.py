"""Behaviour cloning on frozen representations: min (pi(z) - a)^2. The reference that uses no reward."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F

from finetune.algorithms.algorithm import Algorithm, Loss
from finetune.features import FeatureBatch
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.options import Options


class BC(Algorithm):
    """See the module."""

    summary = "behaviour cloning, which uses no reward"

    def __init__(
        self, policy: Policy, options: Options, learning_rate: float, updates: int, generator: torch.Generator
    ) -> None:
        self.policy = policy
        self.optimiser = torch.optim.Adam(policy.net.parameters(), lr=learning_rate, fused=True)

    def losses(self, batch: FeatureBatch) -> Iterator[Loss]:
        """See the module."""
        loss = F.mse_loss(self.policy(batch.z), batch.action)
        yield Loss(loss, self.optimiser, {"bc_loss": loss.detach()})

    def parts(self) -> dict[str, Any]:
        """The policy and its optimiser."""
        return {"policy": self.policy, "optimiser": self.optimiser}
