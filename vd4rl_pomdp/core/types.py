"""The time axis and the batches every part of the harness exchanges.

Rows follow dm_env: row t holds the frame o_t and the action and reward that led INTO it.

    row         0        1        2      ...   T          one episode = T+1 rows, T transitions
    frame       o_0      o_1      o_2    ...   o_T
    action[t]   0        a_0      a_1    ...   a_{T-1}    so a_t = action[t+1]
    reward[t]   0        r_0      r_1    ...   r_{T-1}    r_t is paid for a_t, stored on row t+1
    step_type   FIRST    MID      MID    ...   LAST       its discount is 1 at a time limit, 0 where a task ends

Shape suffixes: B batch, T rows of a window, S frames of a stack, C = 3*S channels, A action dimension.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any, Self

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import MOST_ROWS

WINDOW = 32
"""Rows of a training window, by default."""


class StepType(IntEnum):
    """dm_env's step types, as stored in V-D4RL's `step_type`."""

    FIRST = 0
    MID = 1
    LAST = 2


_T_BITS = (MOST_ROWS - 1).bit_length()
"""Bits for the row number in a `row_key`."""


def row_key(episode: Tensor, t: Tensor) -> Tensor:
    """Unique int64 key of row t of an episode, the same in a dataset and in the environment."""
    return (episode << _T_BITS) | t


def unpack_row_key(key: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and t of a `row_key`."""
    return key >> _T_BITS, key & ((1 << _T_BITS) - 1)


@dataclass(frozen=True)
class Batch:
    """Tensors that share their first dimension. Fields can also be read as `batch["obs"]`."""

    def __getitem__(self, name: str) -> Tensor:
        if name not in self.keys():
            raise KeyError(name)
        return getattr(self, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def keys(self) -> tuple[str, ...]:
        return tuple(f.name for f in fields(self))

    def to(self, device: torch.device | str) -> Self:
        """Copy of the batch with every tensor on `device`."""
        ahead = torch.device(device).type != "cpu"  # a non-blocking copy to the CPU could be read before it is done
        return self.replace(**{name: self[name].to(device, non_blocking=ahead) for name in self.keys()})

    def replace(self, **changes: Any) -> Self:
        return replace(self, **changes)


@dataclass(frozen=True)
class Transitions(Batch):
    """n-step transitions (o_t, a_t, r, d, o_{t+n}); none crosses the end of an episode."""

    obs: Tensor
    """(B, C, H, W) uint8: frames t-2..t, oldest first; an episode's first frame is repeated at its start."""
    action: Tensor
    """(B, A) float32: a_t."""
    reward: Tensor
    """(B,) float32: sum of gamma^i d_i r_{t+i} up to t+n or the end of the episode, where d_i is the product of the
    preceding stored discounts."""
    discount: Tensor
    """(B,) float32: product of the stored discounts, times gamma for every step after the first."""
    next_obs: Tensor
    """(B, C, H, W) uint8: the stack at t+n, or at the episode's last row if that comes first."""
    key: Tensor
    """(B,) int64: `row_key` of row t, the random key of `emission` corruptions."""
    next_key: Tensor
    """(B,) int64: `row_key` of next_obs."""
    next_action: Tensor
    """(B, A) float32: the action at next_obs; zero at the episode's last row, which has none."""


@dataclass(frozen=True)
class Windows(Batch):
    """Consecutive rows of one episode each. Row j shows o_j, a_{j-1} (`prev_action`) and a_j (`action`)."""

    obs: Tensor
    """(B, T, C, H, W) uint8: one frame stack per row, built within the episode (it may reach before the window)."""
    prev_action: Tensor
    """(B, T, A) float32: a_{j-1}; zero in the window's first row and in padding."""
    action: Tensor
    """(B, T, A) float32: a_j; zero where `has_action` is False."""
    has_action: Tensor
    """(B, T) bool: False in padding and at an episode's last row, where no a_j exists."""
    length: Tensor
    """(B,) int64: real rows of each window; rows from this index on are padding."""
    key: Tensor
    """(B, T) int64: `row_key` of every row, the random key of `emission` corruptions."""

    @property
    def real(self) -> Tensor:
        """(B, T) bool: True for real rows, False for padding."""
        return torch.arange(self.has_action.shape[1], device=self.length.device) < self.length[:, None]


def previous(action: Tensor) -> Tensor:
    """Shift (B, T, A) actions a_j to a_{j-1}, with zeros in the first row, as `Windows.prev_action`."""
    return torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], dim=1)


@dataclass(frozen=True)
class StateWindows(Windows):
    """Windows with the true simulator state, only for methods that are trained on it."""

    state: Tensor
    """(B, T, P) float32: pose and velocity of every row, as in `Dataset.states`."""
