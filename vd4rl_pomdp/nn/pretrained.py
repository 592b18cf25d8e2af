"""Frozen image models from transformers, such as DINOv2; loaded from the local cache or a folder, never downloaded."""

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
"""ImageNet statistics; DINOv2, DINOv3 and R3M expect images standardised by them."""
AT_ONCE = 256
"""Batch size in frames, which bounds memory."""


class Pretrained(nn.Module):
    """Applies a frozen model to each frame of a stack: (N, 3 S, H, W) in [-0.5, 0.5] -> (N, S D, 1, 1).

    A frame's features are the model's pooled output or, if the model has none, its first token.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, name: str, size: int, weights: str, channels: int) -> None:
        """Load the model; see `PretrainedOptions`, and UserError if transformers or the model is missing."""
        super().__init__()
        if channels % 3:
            raise UserError(f"--frame-encoder pretrained needs frames of 3 channels, not {channels}")
        model, content = _load(name), hashlib.blake2b(digest_size=16)
        for key, value in sorted(model.state_dict().items()):
            content.update(f"{key} {tuple(value.shape)}".encode())
            content.update(value.contiguous().numpy().tobytes())
        found = content.hexdigest()
        if weights not in ("", found):
            raise UserError(
                f"--model {name}: its weights are {found} by content, not {weights}: name the folder of those"
            )
        # In a list it is not a submodule: it is neither trained nor saved, and stays in eval mode.
        self._model = [model]
        self.size, self.found = size, {"weights": found}
        for key, values in (("mean", MEAN), ("std", STD)):
            self.register_buffer(key, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        frames = F.interpolate(image.unflatten(1, (-1, 3)).flatten(0, 1), (self.size, self.size), mode="bilinear")
        frames = (frames + 0.5 - self.mean) / self.std
        features = []
        for part in frames.split(AT_ONCE):
            output = self._model[0](part)
            pooled = getattr(output, "pooler_output", None)
            features.append((output.last_hidden_state[:, 0] if pooled is None else pooled).flatten(1))
        return torch.cat(features).reshape(len(image), -1, 1, 1)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self._model[0]._apply(fn)  # not a submodule, so move it along in .to(), .cuda(), .half()
        return super()._apply(fn, recurse)


def _load(name: str) -> Any:
    """Load a model in float32 and eval mode, without gradients."""
    try:
        import transformers
    except ImportError as error:
        extra = "pip install '.[pretrained]' in a clone of vd4rl-pomdp"
        raise UserError(f"--frame-encoder pretrained needs transformers: {extra}") from error
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    local: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "dtype": torch.float32}
    try:
        with fork_rng(devices=[]):  # the random initial weights are overwritten: keep the caller's RNG state
            model = transformers.AutoModel.from_pretrained(name, **local)
    except (OSError, ValueError) as error:
        raise UserError(
            f"--model {name}: cannot be loaded from this machine ({first_line(error)}): run `hf download {name}` once "
            "where there is a network, or name a folder that transformers' save_pretrained wrote"
        ) from error
    return model.eval().requires_grad_(False)
