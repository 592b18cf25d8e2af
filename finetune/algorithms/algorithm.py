"""Base class of fine-tuning algorithms: plain losses of a batch, and an update that minimises them in order."""

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
    """Discount per decision."""
    n_step: int = 3
    """Steps of the n-step return."""

    limits: ClassVar[Limits] = {"gamma": (0, 1), "n_step": (1, 1000)}


class Loss(NamedTuple):
    """A loss of a batch."""

    value: Tensor
    """Scalar."""
    logs: dict[str, Tensor]
    """Detached scalars by name, unique among the losses of an update; `step` is reserved."""


class Algorithm(ABC):
    """Trains a policy on batches of representations.

    When updates are replayed as CUDA graphs, Python runs only a few of them. When runs are stacked (`finetune.stack`),
    `update` sees the batches of all runs at once, but each loss sees one. An algorithm that follows this interface
    needs no extra code for either.
    """

    options: type[Options] = Options
    summary: str = ""
    period: int = 1
    """Number of updates after which the Python control flow repeats, e.g. 2 if every second update trains the actor."""

    def __init__(self, policy: Policy, options: Any, learning_rate: float, updates: int, draws: RandomStream) -> None:
        """Subclasses add their networks and optimisers, on the policy's device.

        Args:
            policy: the policy to train.
            options: an instance of the class's `options`, stored as `settings`.
            learning_rate: for all optimisers.
            updates: total number of updates, for schedules; stored as `planned`.
            draws: source of random numbers. Draw in `update`, never in a loss: a stack's update draws for all runs.
        """
        self.policy, self.settings, self.learning_rate = policy, options, learning_rate
        self.planned, self.draws = updates, draws
        self.updates: int | Tensor = 0
        """Updates done: an int or, when replayed, a 0-dim tensor."""
        self._turn = 0

    @property
    def turn(self) -> int:
        """Position of the current update within a `period`, 0 to period - 1, as an int for Python control flow."""
        return self._turn if isinstance(self.updates, Tensor) else self.updates % self.period

    def count_on(self, device: torch.device) -> None:
        """Count updates in a tensor from now on, which replayed updates can read and increment."""
        self.updates = torch.tensor(int(self.updates), device=device)

    def take_turn(self, turn: int) -> None:
        """Set the turn of the next update, since Python cannot branch on a tensor during capture."""
        self._turn = turn

    @abstractmethod
    def update(self, batch: FeatureBatch, *encoder: Optimizer) -> dict[str, Tensor]:
        """Call `minimise` for each loss in turn, then count the update: `self.updates += 1`.

        Args:
            batch: transitions of representations; for stacked runs, tensors have a leading dimension S.
            encoder: optimiser of the encoder that computed `batch.z`, if it is trained. It steps along the first loss,
                the only one whose gradient may reach `batch.z`.

        Returns:
            Detached scalars of all losses by name; (S,) for stacked runs.
        """

    def minimise(
        self, loss_function: Callable[..., Loss], batch: FeatureBatch, *tensors: Tensor, along: Sequence[Optimizer]
    ) -> dict[str, Tensor]:
        """Compute a loss of each run's batch and tensors, step the optimisers `along` it, and return its logs.

        `loss_function` is a method of this algorithm that changes nothing and draws nothing; `tensors` are its other
        arguments, such as random numbers drawn for it.
        """
        loss = self.each(loss_function, batch, *tensors)
        self.step(loss, *along)
        return dict(loss.logs)

    def each(self, function: Callable[..., Result], batch: FeatureBatch, *tensors: Tensor) -> Result:
        """Apply a function that is not a loss to a batch; for stacked runs, to each run's batch."""
        return function(batch, *tensors)

    def step(self, loss: Loss, *optimisers: Optimizer) -> None:
        """Take a gradient step in full precision. Only the optimisers' parameters change."""
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        updated = [p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]]
        with torch.autocast(loss.value.device.type, enabled=False):
            # `inputs` skips gradients of the critics, through which an actor's loss runs. Stacked runs share no
            # parameters, so the gradient of the sum of their losses is each run's own.
            loss.value.backward(torch.ones_like(loss.value), inputs=updated)
        for optimiser in optimisers:
            optimiser.step()

    def parts(self) -> dict[str, Any]:
        """The networks, targets and optimisers among its attributes, by name. The target of `x` is named `target_x`."""
        return {name: part for name, part in vars(self).items() if isinstance(part, nn.Module | Optimizer)}

    def state_dict(self) -> dict[str, Any]:
        parts = {name: part.state_dict() for name, part in self.parts().items()}
        return parts | {"updates": int(self.updates), "noise": self.draws.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self.parts().items():
            part.load_state_dict(state[name])
        if isinstance(self.updates, Tensor):
            self.updates.fill_(state["updates"])
        else:
            self.updates = state["updates"]
        self.draws.set_state(state["noise"])


def share_of(done: int | Tensor, whole: float) -> float | Tensor:
    """Completed fraction of `whole`, at most 1; a float or, for a tensor, a tensor."""
    if isinstance(done, Tensor):
        return (done.double() / whole).clamp(max=1.0)
    return min(1.0, done / whole)
