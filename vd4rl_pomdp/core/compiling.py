"""Functions that torch compiles on a GPU, where many small kernels become a few; a CPU runs them as written."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import first_line


def compiled_on_gpu(training: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a function that is compiled where one of its arguments is a tensor on a GPU.

    Where that fails, for want of a C compiler or whatever reason, one line says so, and it runs as it is written, which
    is its attribute `__wrapped__`. `TORCH_COMPILE_DISABLE=1` in the environment turns compiling off.

    Args:
        training: only where gradients are wanted: elsewhere sizes vary, and compiling takes longer than it saves.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        compiled, failed = None, False

        @wraps(function)
        def call(*args: Any) -> Any:
            nonlocal compiled, failed
            on_gpu = any(isinstance(arg, Tensor) and arg.is_cuda for arg in args)
            if failed or not on_gpu or (training and not torch.is_grad_enabled()):
                return function(*args)
            try:
                if compiled is None:
                    from torch._functorch import config  # only here: it takes seconds to import what compiles

                    config.donated_buffer = False  # or a loss could not keep its graph for a second gradient
                    compiled = torch.compile(function)
                return compiled(*args)
            except torch.OutOfMemoryError:
                raise
            except Exception as error:
                out = function(*args)  # what is wrong with the arguments is raised here
                failed = True
                line = f"warning: {function.__qualname__} is not compiled, which is slower: {first_line(error)}"
                print(line, file=sys.stderr, flush=True)
                return out

        return call

    return decorate
