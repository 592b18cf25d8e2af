"""Capture training steps as CUDA graphs and replay them: some hundred kernel launches become one.

A step is a function whose only argument is its turn. Everything else that changes between steps must be read from
tensors that stay in place: weights, optimiser state, counters, random numbers (`RandomStream`, `KeyStream`). A step
that cannot be captured, because Python branches on a value or keeps its own number, runs eagerly after one warning.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from vd4rl_pomdp.core.errors import first_line
from vd4rl_pomdp.core.streams import RandomStream

Logs = dict[str, Tensor]
Capture = Callable[[Callable[[], Tensor]], tuple[Callable[[], None], Tensor]]
"""Takes a function without running it; returns a function that replays it, and the tensor that then holds its
result."""
EAGER_VARIABLE = "VD4RL_POMDP_EAGER"  # 1: no step is replayed; 0: a step that cannot be captured raises
WARM_UP = 3  # eager steps per turn before capture: libraries pick kernels and optimisers create their state


class Replay:
    """Runs training steps; on a GPU, replays them as CUDA graphs after the first few. Each call is one step."""

    def __init__(
        self,
        step: Callable[[int], Logs],
        device: torch.device,
        streams: Sequence[RandomStream] = (),
        period: int = 1,
        trained: Sequence[Any] = (),
        capture: Capture | None = None,
        obstacle: str = "",
    ) -> None:
        """See the class.

        Args:
            step: does the step of a turn, 0 to period - 1. Returns scalars, or one-element-per-run tensors.
            device: device of the step.
            streams: all random streams that it uses.
            period: steps after which the Python control flow repeats, e.g. 2 if every second step trains the actor.
            trained: objects that the step changes; replay requires that Python numbers in them stay constant.
            capture: how to capture; None: CUDA graphs on a GPU, nothing elsewhere.
            obstacle: why the step cannot be captured, if that is known.
        """
        self._step, self._streams, self._period, self._trained = step, streams, period, trained
        self._side = torch.cuda.Stream(device) if device.type == "cuda" else None
        if capture is None and self._side is not None and os.environ.get(EAGER_VARIABLE) != "1":
            capture = _cuda_graphs(self._side)
        self._capture, self._obstacle = capture, obstacle
        self._eager = 0
        self._steps: dict[int, tuple[Callable[[], None], list[str], Tensor]] = {}
        """By turn: its replay function, and the names and tensor of its scalars."""

    @property
    def replays(self) -> bool:
        """Whether steps are replayed, now or after the warm-up."""
        return self._capture is not None

    def __call__(self, turn: int) -> Logs:
        """Do the step of a turn; turns must come in order. Returns copies of this step's scalars."""
        with self._on_side():
            if self._capture is None:
                return self._step(turn)
            if turn not in self._steps and not self._ready(turn):
                self._eager += 1
                return self._run(turn)
            for stream in self._streams:
                stream.provide(turn)
            replay, names, values = self._steps[turn]
            replay()
            return dict(zip(names, values.clone().unbind(), strict=True))

    def _run(self, turn: int) -> Logs:
        for stream in self._streams:
            stream.begin(turn)
        logs = self._step(turn)
        for stream in self._streams:
            stream.end()
        return logs

    def _ready(self, turn: int) -> bool:
        """Whether the step can be replayed. All turns are captured at the first turn 0 after the warm-up."""
        if turn != 0 or self._eager < WARM_UP * self._period:
            if turn == 0:
                self._before = python_state(self._trained)
            return False
        try:
            if self._obstacle:
                raise RuntimeError(self._obstacle)
            if changed := changed_in(self._before, python_state(self._trained)):
                raise RuntimeError(f"{changed} changes from step to step")
            for stream in self._streams:
                stream.in_blocks()
            for each in range(self._period):
                self._steps[each] = self._captured(each)
        except Exception as error:  # any failure: run eagerly instead
            if os.environ.get(EAGER_VARIABLE) == "0":
                raise
            cause: BaseException = error
            while cause.__context__ is not None:  # ending a failed capture raises, too
                cause = cause.__context__
            self._capture, self._steps = None, {}
            for stream in self._streams:
                stream.one_by_one()
            line = "warning: steps are run one by one, not replayed as a CUDA graph, which is slower: "
            print(line + first_line(cause), file=sys.stderr, flush=True)
        return self._capture is not None

    def _captured(self, turn: int) -> tuple[Callable[[], None], list[str], Tensor]:
        assert self._capture is not None
        names: list[str] = []

        def step() -> Tensor:
            logs = self._run(turn)
            names.extend(logs)
            # one number each, or one per run in a stack
            return torch.stack([value.detach().float().squeeze() for value in logs.values()])

        replay, values = self._capture(step)
        return replay, names, values

    @contextmanager
    def _on_side(self) -> Iterator[None]:
        """Run on a side stream, as capture requires, ordered after earlier and before later work."""
        if self._side is None:
            yield
            return
        current = torch.cuda.current_stream(self._side.device)
        self._side.wait_stream(current)
        with torch.cuda.stream(self._side):
            yield
        current.wait_stream(self._side)


def _cuda_graphs(stream: torch.cuda.Stream) -> Capture:
    """Capture as CUDA graphs in a shared memory pool, which is safe as they are replayed in sequence."""
    pool = torch.cuda.graph_pool_handle()

    def capture(function: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        graph = torch.cuda.CUDAGraph()
        gc.collect()
        gc.disable()  # an old graph that is freed during a capture would break it
        try:
            # thread_local: ignore GPU work of other threads
            with torch.cuda.graph(graph, pool, stream, capture_error_mode="thread_local"):
                result = function()
        except Exception:
            # before torch 2.13, the allocator still records into the pool (github.com/pytorch/pytorch/pull/180395):
            # empty_cache() and later captures would fail
            with suppress(RuntimeError, AttributeError):
                torch._C._cuda_endAllocateToPool(stream.device.index, pool)
            raise
        finally:
            gc.enable()
        return graph.replay, result

    return capture


def python_state(objects: Sequence[Any]) -> dict[str, Any]:
    """Values in the attributes of objects, and of modules and optimisers in them, by name.

    Numbers and strings by value, tensors by identity: replacing a tensor counts as a change, because a replayed step
    would not see it; writing into one does not.
    """
    found: dict[str, Any] = {}
    seen: set[int] = set()

    def visit(name: str, value: Any) -> None:
        if isinstance(value, bool | int | float | str | Tensor):
            found[name] = value
            return
        if id(value) in seen or isinstance(value, RandomStream):
            return
        seen.add(id(value))
        if isinstance(value, Optimizer):
            visit(f"{name}.param_groups", value.param_groups)
        elif isinstance(value, Mapping):
            for key, item in value.items():
                visit(f"{name}.{key}", item)
        elif isinstance(value, list | tuple):
            for number, item in enumerate(value):
                visit(f"{name}.{number}", item)
        elif isinstance(value, nn.Module) or any(value is one for one in objects):
            visit(name, vars(value))

    for one in objects:
        visit(type(one).__name__, one)
    return found


def changed_in(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Name of an attribute that changed, or ""."""
    for name in before.keys() | after.keys():
        one, other = before.get(name), after.get(name)
        if one is not other if isinstance(one, Tensor) or isinstance(other, Tensor) else one != other:
            return name
    return ""
