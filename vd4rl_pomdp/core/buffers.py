"""Memory on the CPU: what numpy may work on in torch's place, and blocks for batches of frames that are used again.

Fresh pages for every batch cost more time than filling them.
"""

from __future__ import annotations

import threading
import weakref

import numpy as np
import torch
from torch import Tensor

_KEPT = 4
"""Blocks kept at most: two for a batch of transitions, twice."""


def in_host_memory(x: Tensor) -> bool:
    """Whether numpy may read and write a tensor, and Python decide by its values, without waiting for a GPU.

    Both ways give the same numbers: the one for CPUs is faster there, the other can be replayed.
    """
    return x.device.type == "cpu"


class FrameBuffers:
    """Lends blocks of CPU memory; a block is lent again once no tensor uses it any more."""

    def __init__(self) -> None:
        self._blocks: list[tuple[np.ndarray, weakref.ref[np.ndarray]]] = []
        """Each block with the view that its borrower holds, gone when the last tensor on it is gone."""
        self._lock = threading.Lock()

    def take(self, shape: tuple[int, ...] | torch.Size) -> Tensor:
        """Uninitialised uint8 tensor of a shape that shares memory with no other living tensor."""
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
"""The process's only lender."""
