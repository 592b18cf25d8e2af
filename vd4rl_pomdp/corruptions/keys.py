"""Counter-based random numbers: integers that depend only on an int64 key, identical on every device.

A key identifies one row of one batch. Hashing it (SplitMix64's finaliser, Steele et al. 2014) gives independent draws
without generator state, so that a corruption can be reproduced, offline or in the environment.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.streams import stream_seed

# SplitMix64's constants as int64: products overflow and wrap around like uint64's.
_GOLDEN = 0x9E3779B97F4A7C15 - (1 << 64)
_MIX_A = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_B = 0x94D049BB133111EB - (1 << 64)
DRAWS = 1 << 31
"""Number of distinct values of a full-range draw."""


def hash_keys(key: Tensor) -> Tensor:
    """Hash int64 keys of any shape to int64 values that look uniform."""
    if hardware.in_host_memory(key):  # for so few numbers numpy is much faster than torch
        return torch.from_numpy(_mix(key.numpy().reshape(-1))).view(key.shape)
    return _mix(key ^ 0)  # a no-op, without which torch.compile treats `arange + constant` as 32-bit index arithmetic


def _mix(key: Any) -> Any:
    key = key + _GOLDEN
    key = (key ^ _shift_right(key, 30)) * _MIX_A
    key = (key ^ _shift_right(key, 27)) * _MIX_B
    return key ^ _shift_right(key, 31)


def _shift_right(x: Any, bits: int) -> Any:
    # logical: `>>` is arithmetic, so mask out the copies of the sign bit
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def derive_keys(seed: int, key: Tensor) -> Tensor:
    """Derive the keys of an independent stream `seed`, one for each int64 in `key`."""
    return hash_keys(_hash_seed(seed) ^ key)


def _hash_seed(seed: int) -> int:
    return (_mix(seed) + (1 << 63)) % (1 << 64) - (1 << 63)  # Python integers do not wrap around


def draw_integers(key: Tensor, high: int, count: int) -> Tensor:
    """Draw `count` integers in [0, high) per key: (...,) int64 -> (..., count) int64."""
    return draw_numbered(key, high, torch.arange(count, device=key.device))


def draw_numbered(key: Tensor, high: int, number: Tensor) -> Tensor:
    """Draws of `draw_integers` with indices `number`, int64 of shape (..., n) or broadcastable with it."""
    key = key.view(*key.shape, *[1] * max(1, number.ndim - key.ndim))
    bits = _shift_right(hash_keys(key ^ hash_keys(number + 1)), 33)
    # Scale 31 bits to [0, high) without a division; the bias is below high / 2^31.
    return (bits * high) >> 31


def draw_normals(key: Tensor, count: int) -> Tensor:
    """Draw `count` standard normal numbers per key: (...,) int64 -> (..., count) float64."""
    return torch.special.ndtri((draw_integers(key, DRAWS, count).double() + 0.5) / DRAWS)


def next_keys(seed: int, position: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Next keys of stream `seed`; `position`, a 0-d int64 tensor, is advanced in place."""
    numbers = position + torch.arange(math.prod(shape), device=position.device)
    position += len(numbers)
    return derive_keys(seed, numbers).view(shape)


class KeyStream:
    """A stream of new keys for every row of every batch. `position` is its complete state, to save and restore."""

    def __init__(self, seed: int, position: int = 0) -> None:
        self.seed = seed
        self.position = torch.tensor(position)
        """0-d int64 tensor on the device of the keys, not a Python int, which a CUDA graph would freeze."""

    def take(self, shape: tuple[int, ...] | torch.Size, device: torch.device | str = "cpu") -> Tensor:
        """Next keys of the stream, int64 of shape `shape`; workers of a DataLoader draw others, new in every epoch."""
        worker = get_worker_info()
        seed = self.seed if worker is None else stream_seed(self.seed, "worker", worker.seed)
        self.position = self.position.to(device, copy=worker is not None)  # spawned workers share its memory
        return next_keys(seed, self.position, tuple(shape))

    def go_to(self, position: int) -> None:
        self.position.fill_(position)
