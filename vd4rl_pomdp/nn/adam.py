"""Adam (Kingma & Ba 2015, arXiv 1412.6980), in the form in which a device can replay its step."""

from __future__ import annotations

from collections.abc import Iterable
from inspect import unwrap
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

_OF_DEVICE = ("capturable", "fused", "foreach")


class Adam(torch.optim.Adam):
    """PyTorch's, whose learning rate and step counts are tensors on a GPU, so that a replayed step reads them.

    A state of another device can be loaded.
    """

    # What PyTorch wraps these in keeps its compiler away, and imports all of that for it: 140 MB, and a second or more.
    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    step = torch.no_grad()(unwrap(torch.optim.Adam.step))

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, fused: bool = False) -> None:
        """See the class.

        Args:
            parameters: on one device.
            learning_rate: of all of them.
            fused: on a CPU, take PyTorch's fused step, which rounds differently; a GPU always does.
        """
        parameters = list(parameters)
        device = parameters[0].device
        gpu = device.type == "cuda"
        rate = torch.tensor(learning_rate, device=device) if gpu else learning_rate
        super().__init__(parameters, lr=rate, fused=True if gpu or fused else None, capturable=gpu)
        self._warned_capturable_if_run_uncaptured = True  # steps before the first replayed one are not captured

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from another's `state_dict`, by this device's kind of step."""
        own = [{name: group[name] for name in (*_OF_DEVICE, "lr")} for group in self.param_groups]
        unwrap(torch.optim.Adam.load_state_dict)(self, state_dict)
        for group, before in zip(self.param_groups, own, strict=True):
            rate = float(group["lr"])
            group.update(before)  # the tensor that a captured step reads stays the same one
            set_rate(group, rate)
            for parameter in self.state.keys() & set(group["params"]):
                counts = parameter.device if group["capturable"] or group["fused"] else "cpu"
                loaded = self.state[parameter]
                # a fused step on a CPU walks through memory: in another layout it would pair wrong numbers, in silence
                moments = {k: torch.empty_like(parameter).copy_(v) for k, v in loaded.items() if k != "step"}
                self.state[parameter] = {"step": loaded["step"].to(counts, torch.float32), **moments}


def set_rate(group: dict[str, Any], rate: float | Tensor) -> None:
    """Set the learning rate of a parameter group, in place where it is a tensor."""
    if isinstance(group["lr"], Tensor):
        group["lr"].copy_(rate) if isinstance(rate, Tensor) else group["lr"].fill_(rate)
    else:
        group["lr"] = rate


def set_learning_rate(optimiser: Optimizer, rate: float | Tensor) -> None:
    """Set the learning rate of an optimiser, in place where it is a tensor, so that a replayed step reads it."""
    for group in optimiser.param_groups:
        set_rate(group, rate)
