"""Frozen image models from transformers, such as DINOv2; loaded from the local cache or a folder, never downloaded."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.random import fork_rng

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.runs.files import read_json

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet statistics, for models that state none; DINOv2, DINOv3 and R3M expect them."""
AT_ONCE = 256
"""Batch size in frames, which bounds memory."""


class Pretrained(nn.Module):
    """Applies a frozen model to each frame of a stack: (N, 3 S, H, W) in [-0.5, 0.5] -> (N, S D, 1, 1).

    A frame's features are the model's pooled output; without one its class token, or else the mean of its tokens.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, name: str, size: int, weights: str, channels: int) -> None:
        """Load the model.

        Args:
            name: a model in transformers' cache, or a folder written by `save_pretrained`.
            size: height and width to which frames are resized, bilinearly.
            weights: required content hash of the model's weights and image statistics; empty: any.
            channels: channels of a stack, 3 per frame.

        Raises:
            UserError: transformers or the model is missing, its weights differ or are incomplete, it cannot encode
                images of this size, is random, or has patches that do not fill them (only where any weights may be
                loaded), or channels is not a multiple of 3.
        """
        super().__init__()
        if channels % 3:
            raise UserError(f"--frame-encoder pretrained needs frames of 3 channels, not {channels}")
        model = _load(name)
        mean, std = _statistics(name)
        found = _content({**model.state_dict(), "image_mean": mean, "image_std": std})
        if weights not in ("", found):
            raise UserError(
                f"--model {name}: its weights are {found} by content, not {weights}: name the folder of those"
            )
        # In a list it is not a submodule: it is neither trained nor saved, and stays in eval mode.
        self._model = [model]
        self._class_token = any("cls_token" in parameter for parameter, _ in model.named_parameters())
        self.size, self.found = size, {"weights": found}
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("std", std, persistent=False)
        ramp = torch.linspace(-0.5, 0.5, channels * size * size).view(1, channels, size, size)
        try:
            first, again = self(ramp), self(ramp)
        except Exception as error:  # a model raises anything, such as assertions of timm
            raise UserError(
                f"--model {name}: cannot encode images of {size}x{size} pixels ({first_line(error)}): choose another "
                "--model-size or --model"
            ) from error
        if not torch.equal(first, again):  # such as MAE, which masks patches at random
            raise UserError(f"--model {name}: its features of one image differ between calls: choose another model")
        patch = getattr(model.config, "patch_size", None)
        # not if its weights are given: an encoder that was trained on what the model sees stays usable
        if not weights and isinstance(patch, int) and size % patch:
            raise UserError(
                f"--model {name}: {size} pixels are no multiple of its patch size {patch}, so it may ignore the last "
                "rows and columns: choose another --model-size"
            )

    def forward(self, image: Tensor) -> Tensor:
        frames = F.interpolate(image.unflatten(1, (-1, 3)).flatten(0, 1), (self.size, self.size), mode="bilinear")
        frames = (frames + 0.5 - self.mean) / self.std
        features = []
        for part in frames.split(AT_ONCE):
            outputs = self._model[0](part)
            pooled = getattr(outputs, "pooler_output", None)
            if pooled is None:
                tokens = outputs.last_hidden_state
                pooled = tokens[:, 0] if self._class_token else tokens.mean(1)
            features.append(pooled.flatten(1))
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
    local["trust_remote_code"] = False  # else it asks whether to run code beside the model
    try:
        with fork_rng(devices=[]):  # the random initial weights are overwritten: keep the caller's RNG state
            model, report = transformers.AutoModel.from_pretrained(name, output_loading_info=True, **local)
    except (OSError, ValueError) as error:
        raise UserError(
            f"--model {name}: cannot be loaded from this machine ({first_line(error)}): run `hf download {name}` once "
            "where there is a network, or name a folder that transformers' save_pretrained wrote (for a saved encoder: "
            "put the model at that path, or change frame_options.model in the encoder's config.json)"
        ) from error
    missing = report["missing_keys"]
    if pooler := {key for key in missing if "pooler." in key}:
        model.pooler = None  # many ViTs are stored without one: transformers would pool by random weights
    if lost := missing - pooler:
        raise UserError(f"--model {name}: its file lacks {len(lost)} weights, such as {min(lost)}: download it again")
    model = getattr(model, "vision_model", model)  # CLIP and SigLIP read text, too
    return model.eval().requires_grad_(False)


def _statistics(name: str) -> tuple[Tensor, Tensor]:
    """Means and deviations (3, 1, 1) by which a model's images are standardised, as its own files state them."""
    from transformers.utils import cached_file

    stated: dict[str, Any] = {}
    with suppress(OSError):  # not every model has the file
        stated = read_json(Path(cached_file(name, "preprocessor_config.json", local_files_only=True)))
    mean, std = stated.get("image_mean", MEAN), stated.get("image_std", STD)
    return torch.tensor(mean).expand(3)[:, None, None], torch.tensor(std).expand(3)[:, None, None]


def _content(tensors: Mapping[str, Tensor]) -> str:
    """Content hash of named tensors: 32 hex digits."""
    found = hashlib.blake2b(digest_size=16)
    for name, value in sorted(tensors.items()):
        found.update(f"{name} {tuple(value.shape)}".encode())
        found.update(value.contiguous().numpy().tobytes())
    return found.hexdigest()
