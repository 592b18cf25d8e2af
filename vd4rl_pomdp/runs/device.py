"""Where tensors live and in which precision the networks run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode

from vd4rl_pomdp.core.errors import UserError

Precision = Literal["fp32", "bf16"]

_PRODUCTS = {
    *(F.linear, F.conv1d, F.conv2d, F.conv3d, torch.matmul, torch.mm, torch.bmm, torch.addmm, torch.baddbmm),
    *(torch.einsum, Tensor.matmul, Tensor.__matmul__, Tensor.mm, Tensor.bmm),
}
"""What autocast computes in bf16, of what encoders, objectives and algorithms call."""


def pick_device(name: str) -> torch.device:
    """Device called `name`; `auto` is the first GPU where there is one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(f"unknown device {name!r}: use auto, cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"unknown device {name!r}: use auto, cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"device {name!r} was asked for, but no such GPU is visible: use --device cpu")
    return device


@contextmanager
def autocast(device: torch.device, precision: Precision) -> Iterator[None]:
    """Context in which a forward pass runs in `precision`, and its gradients are computed in it, too.

    bf16 products are of bf16 numbers, summed in fp32 and rounded: what a set of instructions computes at once, other
    CPUs compute in fp32, from the same rounded numbers. A GPU's autocast leaves other operations (norms) in fp32.
    """
    bf16 = precision == "bf16"
    rounded = RoundedProducts() if bf16 and device.type == "cpu" and not has_bf16_kernels() else nullcontext()
    with torch.autocast(device.type, torch.bfloat16, enabled=bf16), rounded:
        yield


@cache
def has_bf16_kernels() -> bool:
    """Whether torch has more for bf16 on this CPU than loops, which take eleven to seventy times as long as fp32."""
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()


class RoundedProducts(TorchFunctionMode):
    """Inside CPU autocast: products of numbers rounded to bf16, computed in fp32, the result rounded to bf16."""

    def __torch_function__(
        self, func: Callable, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """The product, where autocast would compute one; anything else as it is."""
        kwargs = kwargs or {}
        if func not in _PRODUCTS or not torch.is_autocast_enabled("cpu"):
            return func(*args, **kwargs)
        with torch.autocast("cpu", enabled=False):
            return func(*map(_rounded, args), **{name: _rounded(value) for name, value in kwargs.items()}).bfloat16()


def _rounded(value: Any) -> Any:
    """A tensor's nearest bf16 numbers as fp32; of a list, every one's; anything else as it is."""
    if isinstance(value, (list, tuple)):
        return type(value)(map(_rounded, value))
    return value.bfloat16().float() if isinstance(value, Tensor) and value.is_floating_point() else value
