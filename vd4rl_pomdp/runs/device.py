"""Where tensors live and in which precision the networks run."""

from __future__ import annotations

from typing import Literal

import torch

from vd4rl_pomdp.core.errors import UserError

Precision = Literal["fp32", "tf32", "bf16"]
"""Of matrix products. tf32: on a GPU their factors have 10 bits of mantissa, as JAX's do by default; elsewhere fp32."""


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


def autocast(device: torch.device, precision: Precision) -> torch.autocast:
    """Context in which a forward pass runs in `precision`, and its gradients are computed in it, too.

    bf16 products are of bf16 numbers, summed in fp32 and rounded; norms and the like stay in fp32.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")


def set_products(device: torch.device, precision: Precision) -> None:
    """Let matrix products of float32 on a GPU be of `precision` from now on, gradients included, in this process.

    PyTorch's convolutions and recurrent layers are in TF32 on a GPU whatever is set here.
    """
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
