"""Frozen image models that transformers knows by name, such as DINOv2: read from this machine, never downloaded."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.random import fork_rng

from vd4rl_pomdp.core.errors import UserError, first_line

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, by which DINOv2, DINOv3 and R3M want pictures standardised."""
AT_ONCE = 256
"""Frames that go through the model together, for memory's sake."""


class Pretrained(nn.Module):
    """Each frame of a stack through a frozen model: (N, 3 S, H, W) in [-0.5, 0.5] -> (N, S D, 1, 1).

    A frame's features are the model's pooled output, or its first token where it pools nothing.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, name: str, size: int, weights: str, channels: int) -> None:
        """Load the model.

        Args:
            name: of a model in transformers' cache, or a folder that its `save_pretrained` wrote.
            size: height and width to which frames are resized, bilinearly.
            weights: content hash that the model's weights must have; empty: any.
            channels: of a stack.

        Raises:
            UserError: transformers or the model is missing, it has other weights, or the channels are no frames.
        """
        super().__init__()
        if channels % 3:
            raise UserError(f"--frame-encoder pretrained reads frames of 3 channels, and {channels} are no frames")
        model = _load(name)
        found = _content(model)
        if weights not in ("", found):
            raise UserError(
                f"--model {name}: its weights are {found} by content, not {weights}: name the folder of those"
            )
        # In a list it is no part of this module: it is neither trained nor saved, and stays in eval mode.
        self._model = [model]
        self.size, self.found = size, {"weights": found}
        for key, values in (("mean", MEAN), ("std", STD)):
            self.register_buffer(key, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        """See the class."""
        frames = F.interpolate(image.unflatten(1, (-1, 3)).flatten(0, 1), (self.size, self.size), mode="bilinear")
        frames = (frames + 0.5 - self.mean) / self.std
        features = []
        for part in frames.split(AT_ONCE):
            told = self._model[0](part)
            pooled = getattr(told, "pooler_output", None)
            features.append((told.last_hidden_state[:, 0] if pooled is None else pooled).flatten(1))
        return torch.cat(features).reshape(len(image), -1, 1, 1)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self._model[0]._apply(fn)  # it goes to a device, or another precision, with what it is no part of
        return super()._apply(fn, recurse)


def _load(name: str) -> Any:
    """A model in eval mode, without gradients, float32."""
    try:
        import transformers
    except ImportError as error:
        extra = "pip install '.[pretrained]' in a clone of vd4rl-pomdp"
        raise UserError(f"--frame-encoder pretrained needs transformers: {extra}") from error
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    local: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "dtype": torch.float32}
    try:
        with fork_rng(devices=[]):  # what is drawn before the weights are read is read over
            model = transformers.AutoModel.from_pretrained(name, **local)
    except (OSError, ValueError) as error:
        raise UserError(
            f"--model {name}: cannot be loaded from this machine ({first_line(error)}): run `hf download {name}` once "
            "where there is a network, or name a folder that transformers' save_pretrained wrote"
        ) from error
    return model.eval().requires_grad_(False)


def _content(model: nn.Module) -> str:
    """Hash of a model's weights, wherever they lie: 32 characters."""
    found = hashlib.blake2b(digest_size=16)
    for name, value in sorted(model.state_dict().items()):
        found.update(f"{name} {tuple(value.shape)}".encode())
        found.update(value.contiguous().numpy().tobytes())
    return found.hexdigest()
