"""Memories: sequence models that run forwards over a window's past, or backwards over its future.

After a frame encoder, a memory computes s_t from the features of rows 0..t and, in "+a" methods, the previous actions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.nn.memories.base import GRU, GRUOptions, Integrator, Memory, MemoryOptions
from vd4rl_pomdp.nn.memories.lru import LRU, LRUOptions
from vd4rl_pomdp.nn.memories.transformer import Transformer, TransformerOptions


@dataclass(frozen=True)
class MemoryPart:
    """How to build a memory."""

    build: Callable[[int, Any], Memory]
    """Called with (input width I, options); usually the memory's class."""
    options: type[MemoryOptions] = MemoryOptions
    summary: str = ""


def _refuse_part(name: str, part: MemoryPart) -> None:
    """Raise UserError for a memory with a reserved name or invalid options."""
    if name in ("none", "method") or "." in name:
        raise UserError("this name is reserved, or has a dot: choose another")
    refuse_options(part.options, MemoryOptions)


MEMORIES: Registry[MemoryPart] = Registry(
    "memory",
    {
        "gru": MemoryPart(GRU, GRUOptions, summary="gated recurrent units, as in the paper"),
        "transformer": MemoryPart(Transformer, TransformerOptions, summary="causal attention to a window of rows"),
        "lru": MemoryPart(LRU, LRUOptions, summary="linear recurrent units, computed in parallel over a window"),
        "integrator": MemoryPart(
            Integrator, GRUOptions, summary="a GRU on only the first observation, later actions and time"
        ),
    },
    lambda part: isinstance(part, MemoryPart),
    "a vd4rl_pomdp.nn.memory.MemoryPart",
    _refuse_part,
    setting="history",
    group="vd4rl_pomdp.memories",
)
"""All memories. Other packages add theirs through the entry point group `vd4rl_pomdp.memories`."""


def make_memory(name: str, inputs: int, settings: Mapping[str, Any], features: int | None = None) -> Memory:
    """Build a memory by name for rows of `inputs` numbers; UserError for an unknown name or option.

    The first `features` numbers are the observation's (None: all), the rest the action's.
    """
    part = MEMORIES.named(name)
    options = part.options.fill(settings)
    if unknown := settings.keys() - vars(options).keys():
        raise UserError(f"memory {name!r} has no option {min(unknown)!r}")
    memory = part.build(inputs, options)
    if not isinstance(memory, Memory):
        raise UserError(f"memory {name!r} builds a {type(memory).__name__}, not a vd4rl_pomdp.nn.memory.Memory")
    memory.features = inputs if features is None else features
    return memory


def run_memory(memory: Memory, x: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Run a memory with autocast disabled: (B, T, I) -> outputs (B, T, H) and the final state; no state: from zero."""
    if state is None:
        state = memory.initial_state(len(x))
    with torch.autocast(x.device.type, enabled=False):
        return memory(x.to(next(memory.parameters()).dtype), state)


def run_backward(memory: Memory, x: Tensor, length: Tensor) -> Tensor:
    """Run a memory from each window's last real row to its first: (B, T, I), (B,) int64 real rows -> (B, T, H).

    Output j depends on rows j..length-1. Outputs at padding rows are meaningless.
    """
    rows = torch.arange(x.shape[1], device=x.device)
    flip = length[:, None] - 1 - rows
    flip = torch.where(flip >= 0, flip, rows)  # padding stays after the real rows
    # The permutation is its own inverse, so it also restores the order of the outputs.
    out, _ = run_memory(memory, _take_rows(x, flip))
    return _take_rows(out, flip)


def run_over_next(memory: Memory, x: Tensor, length: Tensor, span: int) -> Tensor:
    """Like `run_backward`, but output j depends on rows j..j+span-1 only, computed from the initial state."""
    batch, rows, width = x.shape
    span = min(span, rows)
    j = torch.arange(rows, device=x.device)
    count = (length[:, None] - j).clamp(1, span)  # rows read for each j; a padding row reads itself
    index = (j[:, None] + count[..., None] - 1 - torch.arange(span, device=x.device)).maximum(j[:, None])
    windows = _take_rows(x, index.view(batch, -1)).view(batch * rows, span, width)
    out, _ = run_memory(memory, windows)
    last = (count - 1).reshape(-1, 1)
    return _take_rows(out, last).view(batch, rows, -1)


def run_over_versions(memory: Memory, versions: Sequence[Tensor], length: Tensor, span: int | None = None) -> Tensor:
    """Like `run_backward` (or `run_over_next` with a span), but a row's input depends on the state that reads it.

    State j reads row j+i from versions[min(i, V-1)], V tensors (B, T, I). With MIK's `future_frames`, V = 3: state j
    reads row j with 1 frame, row j+1 with 2, and later rows with all 3.
    """
    last = len(versions) - 1
    batch, rows, _ = versions[0].shape
    state = memory.initial_state(batch)
    states, outputs = [state] * (rows + last), list[Tensor]()
    if span is None:  # from row j+V-1 on all states read the same inputs, so they share one backward pass
        for j in reversed(range(rows)):
            output, ahead = run_memory(memory, versions[last][:, j, None], state)
            states[j] = state = torch.where((j < length)[:, None], ahead, state)
            outputs.insert(0, output)
        own = last
    else:
        own = min(span, rows)
    state = torch.stack(states[last:], dim=2).flatten(1, 2)
    output = torch.cat(outputs, dim=1) if outputs else state  # a placeholder; the loop below replaces it
    real = torch.arange(rows, device=length.device) < length[:, None]
    for i in reversed(range(own)):
        x = pad(versions[min(i, last)][:, i:], (0, 0, 0, min(i, rows)))
        there = pad(real[:, i:], (0, min(i, rows))).flatten()
        output, ahead = run_memory(memory, x.flatten(0, 1)[:, None], state)
        state = torch.where(there[:, None], ahead, state)
    return output.reshape(batch, rows, -1)


def _take_rows(x: Tensor, index: Tensor) -> Tensor:
    """Gather rows of (B, T, I) by (B, T') indices: (B, T', I)."""
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[2]))
