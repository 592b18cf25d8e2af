"""The machine: devices and precision, memory for batches of frames, compiled functions."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
import weakref
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, first_line, flag_of

Precision = Literal["fp32", "tf32", "bf16"]
"""Precision of matrix products. tf32: on a GPU, inputs have 10 mantissa bits, as is JAX's default; elsewhere fp32."""


def pick_device(name: str) -> torch.device:
    """Device named `name`; `auto` is the first GPU if there is one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(f"unknown device {name!r}: use auto, cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"unknown device {name!r}: use auto, cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"device {name!r} was requested, but no such GPU is visible: use --device cpu")
    return device


_RUNNING = Path("/proc/loadavg")
"""Linux: its fourth field is the number of threads that run now, and of all."""


def warn_of_busy_cores(device: torch.device) -> None:
    """Warn before convolutions are trained with several threads while other programs use half of the cores or more.

    In backward convolutions, oneDNN's threads spin until all of them arrive, whatever OpenMP's wait policy: on two
    cores, two pretrainings with two threads each took 47 times as long as one.
    """
    threads = torch.get_num_threads()
    if device.type != "cpu" or threads == 1 or not _RUNNING.exists():
        return
    if len(os.sched_getaffinity(0)) < (os.cpu_count() or 1):
        return  # the running threads may be on other cores
    counts = []
    for _ in range(5):  # the smallest of several, since programs wake for a moment
        counts.append(int(_RUNNING.read_text(encoding="ascii").split()[3].partition("/")[0]) - 1)
        time.sleep(0.01)
    others, cores = min(counts), len(os.sched_getaffinity(0))
    if others + threads > cores <= 2 * others:
        print(
            f"warning: other programs use {min(others, cores)} of {cores} cores, so {threads} threads that wait for "
            "each other can be many times slower than one: interrupt, and resume with OMP_NUM_THREADS=1",
            file=sys.stderr,
        )


def bf16_kernels() -> bool:
    """Whether oneDNN has bf16 kernels for this CPU; without them PyTorch's take several times as long as fp32."""
    return bool(torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def warn_of_slow_bf16(device: torch.device, **precisions: Precision) -> None:
    """Warn before training in bf16 on a CPU that is faster in fp32; `precisions` by the name of their setting."""
    flags = " ".join(f"{flag_of(name)} fp32" for name, precision in precisions.items() if precision == "bf16")
    if flags and device.type == "cpu" and not bf16_kernels():
        print(
            "warning: this CPU has no bf16 kernels, so bf16 is several times slower than fp32: consider a new run with "
            f"{flags}",
            file=sys.stderr,
        )


def autocast(device: torch.device, precision: Precision) -> torch.autocast:
    """Context in which a forward pass and its gradients run in `precision`.

    bf16 products are accumulated in fp32 and rounded to bf16; norms and similar operations stay in fp32.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")


def set_products(device: torch.device, precision: Precision) -> None:
    """Set the precision of float32 matrix products on a GPU, gradients included, for the rest of this process.

    PyTorch runs convolutions and recurrent layers in TF32 on a GPU regardless of this setting.
    """
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")


_KEPT = 4
"""Maximum number of blocks: two per batch of transitions (obs and next_obs), for two batches."""


def in_host_memory(x: Tensor) -> bool:
    """Whether numpy and Python may read a tensor's values without a GPU sync.

    Callers have two code paths with equal results: a faster one for the CPU, and one that CUDA graphs can capture.
    """
    return x.device.type == "cpu"


class FrameBuffers:
    """Lends blocks of CPU memory; a block is reused once no tensor refers to it.

    Page-faulting fresh memory for every batch costs more time than filling it.
    """

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


def compiled_on_gpu(function: Callable[..., Any]) -> Any:
    """Decorator that fuses a function's kernels by torch.compile in training, when an argument is a CUDA tensor.

    If compilation fails, e.g. without a C compiler, it warns once and runs the original function, available as
    `__wrapped__`. `TORCH_COMPILE_DISABLE=1` in the environment turns compilation off. Without gradients nothing is
    compiled: shapes vary there, so compilation does not pay off.
    """
    compiled, failed = None, False

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal compiled, failed
        on_gpu = any(isinstance(arg, Tensor) and arg.is_cuda for arg in args)
        if failed or not on_gpu or not torch.is_grad_enabled():
            return function(*args)
        try:
            if compiled is None:
                from torch._functorch import config  # imported here: loading the compiler takes seconds

                config.donated_buffer = False  # else `retain_graph=True` fails
                # advises a setting that `set_products` makes from --precision
                warnings.filterwarnings("ignore", "TensorFloat32 tensor cores")
                compiled = torch.compile(function)
            return compiled(*args)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            out = function(*args)  # raises if the arguments were at fault
            failed = True
            line = f"warning: {function.__qualname__} is not compiled, which is slower: {first_line(error)}"
            print(line, file=sys.stderr, flush=True)
            return out

    return call
