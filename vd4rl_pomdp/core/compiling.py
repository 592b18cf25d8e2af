"""Functions that torch compiles on a GPU, where many small kernels become a few; a CPU runs them as written."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import first_line


def compiled_on_gpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, compiled where one of its arguments is a tensor on a GPU.

    Where that fails, for want of a C compiler or whatever reason, one line says so, and it runs as it is written.
    `TORCH_COMPILE_DISABLE=1` in the environment turns compiling off.
    """
    compiled, failed = None, False

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal compiled, failed
        if failed or not any(isinstance(arg, Tensor) and arg.is_cuda for arg in args):
            return function(*args)
        try:
            compiled = compiled or torch.compile(function)  # not before: it takes seconds to import what compiles
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
