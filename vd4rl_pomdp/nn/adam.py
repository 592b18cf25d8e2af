"""Adam (Kingma & Ba 2015, arXiv 1412.6980) whose step can be captured in a CUDA graph."""

from __future__ import annotations

from collections.abc import Iterable
from inspect import unwrap
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

_OF_DEVICE = ("capturable", "fused", "foreach")


class Adam(torch.optim.Adam):
    """PyTorch's Adam; on a GPU, learning rate and step counts are tensors, so that a replayed CUDA graph reads them.

    A state_dict saved on another device can be loaded.
    """

    # PyTorch's wrappers around these methods import torch._dynamo: 140 MB, and a second or more. Use the bare methods.
    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    step = torch.no_grad()(unwrap(torch.optim.Adam.step))

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, fused: bool = False) -> None:
        """Initialise; `fused` uses PyTorch's fused step on a CPU, which rounds differently; a GPU always uses it."""
        parameters = list(parameters)
        device = parameters[0].device
        gpu = device.type == "cuda"
        rate = torch.tensor(learning_rate, device=device) if gpu else learning_rate
        super().__init__(parameters, lr=rate, fused=True if gpu or fused else None, capturable=gpu)
        self._warned_capturable_if_run_uncaptured = True  # silence it: warm-up steps run before the capture

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load another optimiser's `state_dict`, keeping this device's kind of step."""
        own = [{name: group[name] for name in (*_OF_DEVICE, "lr")} for group in self.param_groups]
        unwrap(torch.optim.Adam.load_state_dict)(self, state_dict)
        for group, before in zip(self.param_groups, own, strict=True):
            rate = float(group["lr"])
            group.update(before)  # keep the learning rate tensor that a captured step reads
            set_rate(group, rate)
            for parameter in self.state.keys() & set(group["params"]):
                counts = parameter.device if group["capturable"] or group["fused"] else "cpu"
                loaded = self.state[parameter]
                # PyTorch's fused CPU step ignores strides: moments in another memory layout would silently be misread
                moments = {k: torch.empty_like(parameter).copy_(v) for k, v in loaded.items() if k != "step"}
                self.state[parameter] = {"step": loaded["step"].to(counts, torch.float32), **moments}


def set_rate(group: dict[str, Any], rate: float | Tensor) -> None:
    """Set the learning rate of a parameter group, in place if it is a tensor."""
    if isinstance(group["lr"], Tensor):
        group["lr"].copy_(rate) if isinstance(rate, Tensor) else group["lr"].fill_(rate)
    else:
        group["lr"] = rate


def set_learning_rate(optimiser: Optimizer, rate: float | Tensor) -> None:
    """Set an optimiser's learning rate, in place if it is a tensor, so that a replayed CUDA graph reads it."""
    for group in optimiser.param_groups:
        set_rate(group, rate)
