"""Reusable CPU memory for batches of frames, and the check whether numpy may work on a tensor directly.

Page-faulting fresh memory for every batch costs more time than filling it.
"""

from __future__ import annotations

import threading
import weakref

import numpy as np
import torch
from torch import Tensor

_KEPT = 4
"""Maximum number of blocks: two per batch of transitions (obs and next_obs), for two batches."""


def in_host_memory(x: Tensor) -> bool:
    """Whether numpy and Python may read a tensor's values without a GPU sync.

    Callers have two code paths with equal results: a faster one for the CPU, and one that CUDA graphs can capture.
    """
    return x.device.type == "cpu"


class FrameBuffers:
    """Lends blocks of CPU memory; a block is reused once no tensor refers to it."""

    def __init__(self) -> None:
        self._blocks: list[tuple[np.ndarray, weakref.ref[np.ndarray]]] = []
        """Each block with a weak reference to the view lent out, which dies with the last tensor that uses it."""
        self._lock = threading.Lock()

    def take(self, shape: tuple[int, ...] | torch.Size) -> Tensor:
        """Uninitialised uint8 tensor that shares memory with no other live tensor."""
        shape = tuple(shape)
        with self._lock:
            idle = [i for i, (_, view) in enumerate(self._blocks) if view() is None]
            fitting = next((i for i in idle if self._blocks[i][0].shape == shape), None)
            block = np.empty(shape, np.uint8) if fitting is None else self._blocks[fitting][0]
            view = block[:]
            if fitting is not None:
                self._blocks[fitting] = block, weakref.ref(view)
            elif len(self._blocks) < _KEPT:
                self._blocks.append((block, weakref.ref(view)))
            elif idle:
                self._blocks[idle[0]] = block, weakref.ref(view)
        return torch.from_numpy(view)


BUFFERS = FrameBuffers()
"""The only instance in a process."""
