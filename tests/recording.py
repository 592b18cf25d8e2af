"""A CUDA graph's stand-in on the CPU: operators are recorded once and run again on the same tensors.

As in a graph, Python code, values read from tensors and random draws are frozen, and the same operations are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.nn.adam import Adam
from vd4rl_pomdp.runs.replay import Replay

_WAITING = {"_local_scalar_dense", "item", "nonzero", "masked_select", "equal", "is_nonzero", "unique", "_unique2"}
_DRAWING = {"rand", "randn", "randint", "randperm", "normal_", "uniform_", "bernoulli_", "random_", "multinomial"}


def _indices(args: tuple) -> list[Tensor | None]:
    return args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else []


class _Recorder(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, tuple, dict, list[Tensor]]] = []
        self._made: set[int] = set()
        self._kept: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        # copied now: lists may change later, and tensors be transposed in place
        now = tree_map(lambda x: x.detach() if isinstance(x, Tensor) else x, (args, kwargs))
        name = func.overloadpacket.__name__
        if name in _WAITING:
            raise RuntimeError(f"operation not permitted when stream is capturing: {name} reads a value")
        if name.startswith("index") and any(x is not None and x.dtype == torch.bool for x in _indices(args)):
            raise RuntimeError(f"operation not permitted when stream is capturing: {name} counts a mask's values")
        if (
            name == "lift_fresh" and args[0].ndim
        ):  # without axes it may be the number of an assignment, which is not sent
            raise RuntimeError("operation not permitted when stream is capturing: a tensor of Python's numbers is sent")
        if name in _DRAWING:
            raise RuntimeError(f"operation not permitted when stream is capturing: {name} draws")
        for number, argument in enumerate(func._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                given = args[number] if number < len(args) else kwargs.get(argument.name)
                for tensor in tree_flatten(given)[0]:
                    self._keep(tensor)
        out = func(*args, **kwargs)
        outs = [x.detach() for x in tree_flatten(out)[0] if isinstance(x, Tensor)]
        read = {x.untyped_storage().data_ptr() for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)}
        self._made |= {x.untyped_storage().data_ptr() for x in outs} - read
        if torch.Tag.inplace_view not in func.tags:
            self.calls.append((func, *now, outs))
        return out

    def _keep(self, tensor: Any) -> None:
        if isinstance(tensor, Tensor):
            storage = tensor.untyped_storage()
            if storage.data_ptr() not in self._made:
                self._kept.setdefault(storage.data_ptr(), (storage, storage.clone()))

    def undo(self) -> None:
        """Restore written tensors, since capturing does not execute."""
        for storage, before in self._kept.values():
            storage.copy_(before)


def record(function: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
    """See `vd4rl_pomdp.runs.replay.Capture`."""
    recorder = _Recorder()
    try:
        with recorder:
            result = function()
    finally:
        recorder.undo()

    @torch.no_grad()
    def replay() -> None:
        for func, args, kwargs, outs in recorder.calls:
            again = [x for x in tree_flatten(func(*args, **kwargs))[0] if isinstance(x, Tensor)]
            for old, new in zip(outs, again, strict=True):
                assert old.shape == new.shape, (func, old.shape, new.shape)
                if old.data_ptr() != new.data_ptr():  # else a view, or written in place
                    old.copy_(new)

    return replay, result


class ReplayedAdam(Adam):
    """Adam on a CPU as on a GPU: fused, with its learning rate in a tensor."""

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, fused: bool = True) -> None:
        super().__init__(parameters, learning_rate, fused=True)
        for group in self.param_groups:
            group["lr"] = torch.tensor(learning_rate)


def replays(patch: pytest.MonkeyPatch, *modules: ModuleType, capture: Any = record) -> None:
    """Make modules that import `Replay` and `Adam` train on the CPU as on a GPU.

    With `capture` None the same operators run without replay.
    """
    patch.setattr(hardware, "in_host_memory", lambda x: False)  # numpy's work would not be recorded
    for module in modules:
        if hasattr(module, "Replay"):
            patch.setattr(module, "Replay", partial(Replay, capture=capture))
        if hasattr(module, "Adam"):
            patch.setattr(module, "Adam", ReplayedAdam)
