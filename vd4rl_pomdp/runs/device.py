"""Device of the tensors and precision of the networks."""

from __future__ import annotations

from typing import Literal

import torch

from vd4rl_pomdp.core.errors import UserError

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
        raise UserError(f"device {name!r} was asked for, but no such GPU is visible: use --device cpu")
    return device


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
