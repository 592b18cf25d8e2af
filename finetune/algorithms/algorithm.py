"""What a fine-tuning algorithm is: losses in order, each with the optimiser that follows its gradient."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from finetune.features import FeatureBatch
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.nn.objective import is_scalar
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.device import Precision, autocast


@dataclass(frozen=True)
class ReturnOptions(Options):
    """Options of algorithms that estimate returns."""

    gamma: float = 0.99
    """Discount of a decision."""
    n_step: int = 3
    """Steps of the n-step return."""

    limits: ClassVar[Limits] = {"gamma": (0, 1), "n_step": 1}


class Loss(NamedTuple):
    """One loss of an update."""

    value: Tensor
    """Scalar."""
    optimiser: Optimizer
    """What steps along its gradient; no other parameter takes any."""
    logs: dict[str, Tensor]
    """Detached scalars."""


class Algorithm(ABC):
    """Trains a policy on batches of representations."""

    policy: Policy
    options: type[Options] = Options
    """Class of its options."""
    summary: str = ""
    """One line that says what it is."""
    precision: Precision = "fp32"
    """Of the matrix products that losses are computed by; gradients are taken outside."""

    @abstractmethod
    def __init__(
        self, policy: Policy, options: Any, learning_rate: float, updates: int, generator: torch.Generator
    ) -> None:
        """Set up the training of a policy.

        Args:
            policy: what is trained; its device is where everything else belongs.
            options: an instance of the class's `options`.
            learning_rate: of all optimisers.
            updates: how many there will be, for schedules.
            generator: what random numbers are drawn from.
        """

    @abstractmethod
    def losses(self, batch: FeatureBatch) -> Iterator[Loss]:
        """The losses of one update; a step is made along each before the next is computed.

        The first is the one that trains the encoder, where there is no frozen stage: its gradient reaches `batch.z`.
        """

    def update(self, batch: FeatureBatch, encoder: Optimizer | None = None) -> dict[str, Tensor]:
        """One update.

        Args:
            batch: transitions of representations.
            encoder: optimiser of what computed `batch.z`, if that is trained too.

        Returns:
            Detached scalars of all losses.
        """
        logs: dict[str, Tensor] = {}
        for loss in self._computed(self.losses(batch), batch.z.device):
            _step(loss.value, [loss.optimiser] if encoder is None else [loss.optimiser, encoder])
            logs |= loss.logs
            encoder = None
        return logs

    def _computed(self, losses: Iterator[Loss], device: torch.device) -> Iterator[Loss]:
        """The same losses, at least one, each computed in the algorithm's precision."""
        if not isinstance(losses, Iterator):
            raise UserError(f"{type(self).__name__}.losses gives a {type(losses).__name__}: let it yield every loss")
        loss = self._next(losses, device)
        if loss is None:
            raise UserError(f"{type(self).__name__}.losses yields no loss: an update steps along one at least")
        while loss is not None:
            yield loss
            loss = self._next(losses, device)

    def _next(self, losses: Iterator[Loss], device: torch.device) -> Loss | None:
        with autocast(device, self.precision):
            given = next(losses, None)
        if given is not None and not _is_loss(given):
            raise UserError(
                f"{type(self).__name__}.losses must yield Loss(a scalar tensor with a gradient, its optimiser, a "
                "dictionary of detached scalars)"
            )
        return given

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Networks, targets and optimisers by name: what has a state of its own. The target of `x` is `target_x`."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on: the state of all parts, and what a subclass adds."""
        return {name: part.state_dict() for name, part in self.parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name, part in self.parts().items():
            part.load_state_dict(state[name])


class NoisyAlgorithm(Algorithm):
    """One whose noise is drawn anew in every update, by a schedule or not."""

    generator: torch.Generator
    """What the noise is drawn from."""
    updates: int = 0
    """Updates that were made."""
    planned: int
    """Updates that there will be."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on."""
        return super().state_dict() | {"updates": self.updates, "noise": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        super().load_state_dict(state)
        self.updates = state["updates"]
        self.generator.set_state(state["noise"])


def require_policy(algorithm: Algorithm) -> None:
    """Raise UserError for an algorithm whose policy could not be played again, or would be left out of checkpoints."""
    policy = algorithm.policy
    if not isinstance(policy, Policy) or _shapes(policy) != _shapes(Policy(**policy.shape)):
        raise UserError(
            f"{type(algorithm).__name__}.policy is not the one that it was given: train that, or what is evaluated and "
            "kept is another"
        )
    parts = algorithm.parts()
    if not isinstance(parts, dict) or not all(hasattr(part, "state_dict") for part in parts.values()):
        raise UserError(
            f"{type(algorithm).__name__}.parts must be a dictionary of networks and optimisers, which have a state_dict"
        )
    if not any(part is algorithm.policy for part in parts.values()):
        raise UserError(
            f"{type(algorithm).__name__}.parts lacks the policy: name all that has a state, or it is not kept"
        )


def _is_loss(given: Any) -> bool:
    match given:
        case Loss(Tensor(requires_grad=True) as value, Optimizer(), dict() as logs):
            return all(map(is_scalar, (value, *logs.values())))
    return False


def _shapes(policy: Policy) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in policy.state_dict().items()}


def _step(loss: Tensor, optimisers: list[Optimizer]) -> None:
    for optimiser in optimisers:
        optimiser.zero_grad(set_to_none=True)
    loss.backward(inputs=[p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]])
    for optimiser in optimisers:
        optimiser.step()
