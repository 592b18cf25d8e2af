"""Train several runs at once: their networks share tensors with a leading run dimension, updated together.

Each run remains a separate algorithm whose tensors are slices of the shared ones, and is evaluated, saved and resumed
as if trained alone. Results equal those of separate runs up to floating-point summation order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.optim import Optimizer
from torch.overrides import TorchFunctionMode
from torch.random import fork_rng

from finetune.algorithms import Algorithm
from finetune.algorithms.algorithm import Result
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.streams import stacked
from vd4rl_pomdp.nn.policy import Policy


class Stack:
    """Algorithms of S >= 2 runs of the same kind, options, sizes and number of updates done."""

    def __init__(self, runs: Sequence[Algorithm]) -> None:
        """Take over the runs' state: their networks become slices of the stack's. `settle` writes back the rest."""
        first = runs[0]
        device = first.policy.standardise.mean.device
        with fork_rng(devices=[]):  # these initial weights are overwritten; keep the global RNG state
            policy = Policy(**first.policy.shape).to(device)
            draws = stacked([run.draws for run in runs])
            whole = type(first)(policy, first.settings, first.learning_rate, first.planned, draws)
        self.runs, self.whole = runs, whole
        """The runs, and the algorithm that updates them all."""
        self._parts = [(part, [run.parts()[name] for run in runs]) for name, part in whole.parts().items()]
        shared: set[int] = set()
        for part, own in self._parts:
            if isinstance(part, nn.Module):
                for tensor, *slices in zip(_tensors(part), *map(_tensors, own), strict=True):
                    if id(tensor) not in shared:  # one part may contain another
                        shared.add(id(tensor))
                        # in place, so that optimisers keep their references
                        tensor.data = torch.stack([each.data for each in slices])
                        for run, each in enumerate(slices):
                            each.data = tensor.data[run]
            if isinstance(part, Optimizer):
                _stack_optimiser(part, own)
        self._modules = _Modules([part for part, _ in self._parts if isinstance(part, nn.Module)])
        self._tensors = dict(chain(self._modules.named_parameters(), self._modules.named_buffers()))
        whole.updates = int(first.updates)
        whole.each = self._each  # type: ignore[method-assign]

    def update(self, batch: FeatureBatch) -> dict[str, Tensor]:
        return self.whole.update(batch)

    def settle(self, number: int) -> None:
        """Write a run's progress back: updates, random state, and its slice of the optimisers' state."""
        run = self.runs[number]
        run.updates = int(self.whole.updates)
        run.draws.set_state(self.whole.draws.get_state(number))
        for part, own in self._parts:
            if isinstance(part, Optimizer):
                _slice_optimiser(part, own[number], number)

    def _each(self, function: Callable[..., Result], batch: FeatureBatch, *tensors: Tensor) -> Result:

        def one(own: dict[str, Tensor], fields: dict[str, Tensor], *more: Tensor) -> Any:
            return functional_call(self._modules, own, (function, FeatureBatch(**fields), *more))

        try:
            with _BatchedLinears():
                found: Result = vmap(one)(self._tensors, {name: batch[name] for name in batch}, *tensors)
        except RuntimeError as error:
            if "vmap" not in str(error):
                raise
            raise UserError(
                f"runs of {type(self.whole).__name__} cannot be stacked ({first_line(error)}): train each by itself"
            ) from error
        return found


class _Modules(nn.Module):
    """Wraps modules, to call a function while they hold other tensors (`functional_call`)."""

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        super().__init__()
        self.all = nn.ModuleList(modules)

    def forward(self, function: Callable[..., Result], *arguments: Any) -> Result:
        return function(*arguments)


def _tensors(module: nn.Module) -> Iterator[Tensor]:
    return chain(module.parameters(), module.buffers())


def _parameters(optimiser: Optimizer) -> list[nn.Parameter]:
    return [parameter for group in optimiser.param_groups for parameter in group["params"]]


def _follows(name: str, value: Any, parameter: Tensor) -> bool:
    """Whether an entry of an optimiser's state is per parameter element (e.g. moments), not a step counter."""
    return isinstance(value, Tensor) and name != "step" and value.shape == parameter.shape


def _stack_optimiser(whole: Optimizer, runs: Sequence[Optimizer]) -> None:
    """Set an optimiser of stacked parameters to the state of the runs' optimisers."""
    for group, first in zip(whole.param_groups, runs[0].param_groups, strict=True):
        group.update({name: _copy(value) for name, value in first.items() if name != "params"})
    for parameter, *own in zip(_parameters(whole), *map(_parameters, runs), strict=True):
        states = [run.state.get(each, {}) for run, each in zip(runs, own, strict=True)]
        for name, value in states[0].items():
            follows = _follows(name, value, own[0])
            whole.state[parameter][name] = torch.stack([state[name] for state in states]) if follows else _copy(value)


def _slice_optimiser(whole: Optimizer, run: Optimizer, number: int) -> None:
    """Set a run's optimiser to its slice of the state."""
    for group, its in zip(whole.param_groups, run.param_groups, strict=True):
        its.update({name: _copy(value) for name, value in group.items() if name != "params"})
    for parameter, own in zip(_parameters(whole), _parameters(run), strict=True):
        for name, value in whole.state[parameter].items():
            run.state[own][name] = value[number] if _follows(name, value, parameter) else _copy(value)


def _copy(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value


class _BatchedLinears(TorchFunctionMode):
    """Within `vmap`, computes linear layers as one product each, weights first.

    PyTorch's own rule adds the bias separately, and yields gradients of transposed weights, which need a copy.
    """

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function is F.linear:
            return _linear(*args, **(kwargs or {}))
        return function(*args, **(kwargs or {}))


def _linear(input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Any:
    return _Linear.apply(input, weight, bias)


class _Linear(torch.autograd.Function):
    """`F.linear` per run, with a vmap rule made of differentiable PyTorch operators."""

    @staticmethod
    def forward(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        return F.linear(x, weight, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def vmap(info: Any, dims: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> tuple[Tensor, int]:
        def leading(tensor: Tensor, dim: int | None) -> Tensor:
            return tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)

        x, weight = leading(x, dims[0]), leading(weight, dims[1])
        rows = x.reshape(len(x), -1, x.shape[-1])
        if bias is None:
            product = torch.bmm(weight, rows.mT)
        else:
            product = torch.baddbmm(leading(bias, dims[2])[..., None], weight, rows.mT)
        return product.mT.reshape(*x.shape[:-1], -1), 0
