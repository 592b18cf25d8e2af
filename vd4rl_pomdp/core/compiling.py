"""torch.compile for functions on a GPU, where it fuses many small kernels; on the CPU they run eagerly."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import first_line


def compiled_on_gpu(training: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function when one of its arguments is a CUDA tensor.

    If compilation fails, e.g. without a C compiler, it warns once and runs the original function, available as
    `__wrapped__`. `TORCH_COMPILE_DISABLE=1` in the environment turns compilation off. With `training` it compiles only
    when gradients are enabled: elsewhere shapes vary, so compilation does not pay off.
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
                    from torch._functorch import config  # imported here: loading the compiler takes seconds

                    config.donated_buffer = False  # else `retain_graph=True` fails
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

    return decorate
