"""What a fine-tuning algorithm is: plain losses of a batch, and the order in which an update minimises them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from finetune.features import FeatureBatch
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.policy import Policy

Result = TypeVar("Result")


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
    """Trains a policy on batches of representations.

    Where updates are replayed, Python runs a few of them only; where runs are stacked, `update` sees all of theirs at
    once, and each loss one (`stack`). Neither needs a line in an algorithm that keeps to what is said here.
    """

    options: type[Options] = Options
    """Class of its options."""
    summary: str = ""
    """One line that says what it is."""
    period: int = 1
    """Updates after which Python does the same again."""

    def __init__(self, policy: Policy, options: Any, learning_rate: float, updates: int, draws: RandomStream) -> None:
        """Subclasses add their networks and optimisers.

        Args:
            policy: what is trained; its device is where everything else belongs.
            options: an instance of the class's `options`, kept as `settings`.
            learning_rate: of all optimisers.
            updates: how many there will be, for schedules, kept as `planned`.
            draws: what random numbers are drawn from, in `update` and not in a loss: a stack's update draws for all.
        """
        self.policy, self.settings, self.learning_rate = policy, options, learning_rate
        self.planned, self.draws = updates, draws
        self.updates: int | Tensor = 0
        """Updates that were made: a number, or where they are replayed a tensor without dimensions."""
        self._turn = 0

    @property
    def turn(self) -> int:
        """Which update of a `period` is made, 0 to period - 1: a number of Python's, to decide by."""
        return self._turn if isinstance(self.updates, Tensor) else self.updates % self.period

    def count_on(self, device: torch.device) -> None:
        """Count updates by a tensor from now on, which replayed updates can read and add to."""
        self.updates = torch.tensor(int(self.updates), device=device)

    def take_turn(self, turn: int) -> None:
        """Tell the turn of the update that comes, which no tensor can."""
        self._turn = turn

    @abstractmethod
    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """`minimise` each loss in turn, and count the update: `self.updates += 1`.

        Args:
            batch: transitions of representations; of stacked runs each tensor has a leading dimension more, S.
            encoder: optimiser of what computed `batch.z`, where that is trained, too: it takes the step along the first
                loss, the only one whose gradient may reach `batch.z`.

        Returns:
            Detached scalars of all losses by name, (S,) of stacked runs.
        """

    def minimise(
        self, loss_function: Callable[..., Loss], batch: FeatureBatch, *tensors: Tensor, along: Sequence[Optimizer]
    ) -> dict[str, Tensor]:
        """Compute a loss of one run's batch and tensors, and step along its gradient.

        Args:
            loss_function: a method of this algorithm; it changes nothing and draws nothing.
            batch: its first argument.
            tensors: what else it is given, random numbers that were drawn for it, say.
            along: optimisers whose parameters move.

        Returns:
            What it logs.
        """
        loss = self.each(loss_function, batch, *tensors)
        self.step(loss, *along)
        return dict(loss.logs)

    def each(self, function: Callable[..., Result], batch: FeatureBatch, *tensors: Tensor) -> Result:
        """What a function that is no loss computes of a batch; of stacked runs, of each one's."""
        return function(batch, *tensors)

    def step(self, loss: Loss, *optimisers: Optimizer) -> None:
        """Step along the gradient of a loss, which is taken in full precision; only the optimisers' parameters move."""
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        asked = [p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]]
        with torch.autocast(loss.value.device.type, enabled=False):
            # an actor's loss runs through the critics, whose own gradients are neither wanted nor computed;
            # losses of stacked runs share no parameter, so the gradient of their sum is each one's own
            loss.value.backward(torch.ones_like(loss.value), inputs=asked)
        for optimiser in optimisers:
            optimiser.step()

    def parts(self) -> dict[str, Any]:
        """The networks, targets and optimisers among its attributes, by name. The target of `x` is `target_x`."""
        return {name: part for name, part in vars(self).items() if isinstance(part, nn.Module | Optimizer)}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume: the state of all parts, the updates made, the noise."""
        parts = {name: part.state_dict() for name, part in self.parts().items()}
        return parts | {"updates": int(self.updates), "noise": self.draws.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name, part in self.parts().items():
            part.load_state_dict(state[name])
        if isinstance(self.updates, Tensor):
            self.updates.fill_(state["updates"])
        else:
            self.updates = state["updates"]
        self.draws.set_state(state["noise"])


def share_of(done: int | Tensor, whole: float) -> float | Tensor:
    """How much of a whole is done, 1 at most: a number of a number, a tensor of one."""
    if isinstance(done, Tensor):
        return (done.double() / whole).clamp(max=1.0)
    return min(1.0, done / whole)
