"""Counter-based random draws: integers that depend on a key alone, the same on every device.

A key is an int64 that names one row of one batch. Hashing it (the finaliser of SplitMix64, Steele et al. 2014) gives
independent draws without a generator's state, so a corruption can be drawn again, offline or in the environment.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core import buffers

# SplitMix64's constants as int64: products overflow, and wrap as those of uint64 do.
_GOLDEN = 0x9E3779B97F4A7C15 - (1 << 64)
_MIX_A = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_B = 0x94D049BB133111EB - (1 << 64)
DRAWS = 1 << 31
"""Integers that a draw tells apart."""


def hash_keys(key: Tensor) -> Tensor:
    """Mix int64 keys of any shape into int64 values that look uniform."""
    if buffers.in_host_memory(key):  # numpy takes a fraction of the time that torch needs for so few numbers
        return torch.from_numpy(_mix(key.numpy().reshape(-1))).view(key.shape)
    return _mix(key ^ 0)  # it changes nothing, but torch.compile would add to a counted number as to a 32-bit index


def _mix(key: Any) -> Any:
    key = key + _GOLDEN
    key = (key ^ _shift_right(key, 30)) * _MIX_A
    key = (key ^ _shift_right(key, 27)) * _MIX_B
    return key ^ _shift_right(key, 31)


def _shift_right(x: Any, bits: int) -> Any:
    """Logical right shift of int64."""
    # `>>` alone would fill in copies of the sign.
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def derive_keys(seed: int, key: Tensor) -> Tensor:
    """Keys of a stream of draws: one for every int64 in `key`, another set for every seed."""
    return hash_keys(_hash_seed(seed) ^ key)


def _hash_seed(seed: int) -> int:
    return (_mix(seed) + (1 << 63)) % (1 << 64) - (1 << 63)  # Python's integers do not wrap by themselves


def draw_integers(key: Tensor, high: int, count: int) -> Tensor:
    """`count` integers in [0, high) from each key: (...,) int64 -> (..., count) int64."""
    return draw_numbered(key, high, torch.arange(count, device=key.device))


def draw_numbered(key: Tensor, high: int, number: Tensor) -> Tensor:
    """The draws called `number`, int64 of shape (..., n) or one that broadcasts with it, of `draw_integers`."""
    key = key.view(*key.shape, *[1] * max(1, number.ndim - key.ndim))
    bits = _shift_right(hash_keys(key ^ hash_keys(number + 1)), 33)
    # 31 bits scaled to `high`, without a division; off from uniform by less than high / 2^31.
    return (bits * high) >> 31


def draw_normals(key: Tensor, count: int) -> Tensor:
    """`count` standard normal numbers from each key: (...,) int64 -> (..., count) float64."""
    return torch.special.ndtri((draw_integers(key, DRAWS, count).double() + 0.5) / DRAWS)


def next_keys(seed: int, position: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The keys of a stream from `position` on, a 0-d int64 tensor that is moved behind them in place."""
    numbers = position + torch.arange(math.prod(shape), device=position.device)
    position += len(numbers)
    return derive_keys(seed, numbers).view(shape)


class KeyStream:
    """Fresh keys for every row of every batch; `position` is its whole state, so it can be saved and restored."""

    def __init__(self, seed: int, position: int = 0) -> None:
        self.seed = seed
        self.position = torch.tensor(position)
        """0-d int64, where keys are wanted: a step that is replayed holds no number of its own."""

    def take(self, shape: tuple[int, ...] | torch.Size, device: torch.device | str = "cpu") -> Tensor:
        """The next keys of the stream, shaped `shape`."""
        self.position = self.position.to(device)
        return next_keys(self.seed, self.position, tuple(shape))

    def go_to(self, position: int) -> None:
        """Go on from a position."""
        self.position.fill_(position)
