"""What a fine-tuning algorithm is: plain losses of a batch, and the order in which an update minimises them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.policy import Policy


@dataclass(frozen=True)
class ReturnOptions(Options):
    """Options of algorithms that estimate returns."""

    gamma: float = 0.99
    """Discount of a decision."""
    n_step: int = 3
    """Steps of the n-step return."""

    limits: ClassVar[Limits] = {"gamma": (0, 1), "n_step": (1, 1000)}


class Loss(NamedTuple):
    """A loss of a batch."""

    value: Tensor
    """Scalar."""
    logs: dict[str, Tensor]
    """Detached scalars by name; no two losses of an update share one, and none is called `step`."""


class Algorithm(ABC):
    """Trains a policy on batches of representations."""

    options: type[Options] = Options
    """Class of its options."""
    summary: str = ""
    """One line that says what it is."""

    def __init__(self, policy: Policy, options: Any, learning_rate: float, updates: int, draws: RandomStream) -> None:
        """Subclasses add their networks and optimisers.

        Args:
            policy: what is trained; its device is where everything else belongs.
            options: an instance of the class's `options`, kept as `settings`.
            learning_rate: of all optimisers.
            updates: how many there will be, for schedules, kept as `planned`.
            draws: what random numbers are drawn from.
        """
        self.policy, self.settings, self.learning_rate = policy, options, learning_rate
        self.planned, self.draws = updates, draws
        self.updates = 0
        """Updates that were made."""

    @abstractmethod
    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """Compute each loss in turn and `step` along it, and count the update.

        Args:
            batch: transitions of representations.
            encoder: optimiser of what computed `batch.z`, where that is trained, too: it takes the step along the first
                loss, the only one whose gradient may reach `batch.z`.

        Returns:
            Detached scalars of all losses by name.
        """

    def step(self, loss: Loss, *optimisers: Optimizer) -> None:
        """Step along the gradient of a loss, which is taken in full precision; only the optimisers' parameters move."""
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        asked = [p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]]
        with torch.autocast(loss.value.device.type, enabled=False):
            # an actor's loss runs through the critics, whose own gradients are neither wanted nor computed
            loss.value.backward(inputs=asked)
        for optimiser in optimisers:
            optimiser.step()

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Networks, targets and optimisers by name: what has a state of its own. The target of `x` is `target_x`."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume: the state of all parts, the updates made, the noise."""
        parts = {name: part.state_dict() for name, part in self.parts().items()}
        return parts | {"updates": self.updates, "noise": self.draws.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name, part in self.parts().items():
            part.load_state_dict(state[name])
        self.updates = state["updates"]
        self.draws.set_state(state["noise"])
