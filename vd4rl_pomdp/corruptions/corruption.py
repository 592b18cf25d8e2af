"""What makes the pixels a POMDP (Wu et al. 2024, section 4.2): patches and zeroed frames of the stack.

A corruption is a pure function of a batch of frame stacks and their keys. The same object serves batches of a data set
(on any device) and the environment at evaluation, and equal keys give equal masks on both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from vd4rl_pomdp.corruptions.keys import KeyStream, derive_keys, draw_integers, hash_keys
from vd4rl_pomdp.errors import UserError, refuse_outside

Mode = Literal["resample", "emission"]
_CHANNELS = 3


class Stage(Protocol):
    """One step of a corruption."""

    def __call__(self, obs: Tensor, key: Tensor) -> None:
        """Change (N, S, 3, H, W) uint8 stacks in place, drawing from (N,) int64 keys."""


def _assign(target: Tensor, index: tuple[Tensor, ...], value: int) -> None:
    """`target[index] = value`; on a CPU by numpy, which is several times as fast."""
    if target.device.type == "cpu":
        target.numpy()[tuple(part.numpy() for part in index)] = value
    else:
        target[index] = value


@dataclass(frozen=True)
class Patch:
    """Squares of every frame, at uniformly random places, take the value `fill`."""

    size: int = 16
    """Side in pixels."""
    count: int = 1
    """Squares a frame."""
    fill: int = 0
    """Value of the covered pixels, 0 to 255."""
    shared: bool = False
    """Whether the frames of a stack share their squares."""

    def __call__(self, obs: Tensor, key: Tensor) -> None:
        """See `Stage`."""
        n, s, _, height, width = obs.shape
        if self.size > min(height, width):
            raise UserError(
                f"patch size {self.size} exceeds the image ({height}x{width}): choose a smaller --patch-size"
            )
        places = self.count * (1 if self.shared else s)
        shape = (n, 1 if self.shared else s, self.count)
        top = draw_integers(key, height - self.size + 1, places).view(shape).expand(n, s, self.count)
        left = draw_integers(hash_keys(key), width - self.size + 1, places).view(shape).expand(n, s, self.count)
        squares = obs.unfold(3, self.size, 1).unfold(4, self.size, 1)
        sample = torch.arange(n, device=obs.device)[:, None, None]
        frame = torch.arange(s, device=obs.device)[:, None]
        _assign(squares.movedim(2, 4), (sample, frame, top, left), self.fill)


@dataclass(frozen=True)
class ZeroFrames:
    """`frames` of the stacked frames, chosen uniformly, become 0; the newest may be among them."""

    frames: int = 2

    def __call__(self, obs: Tensor, key: Tensor) -> None:
        """See `Stage`."""
        n, s = obs.shape[:2]
        if self.frames > s:
            raise UserError(f"cannot zero {self.frames} of {s} stacked frames: choose a smaller --zeroed-frames")
        order = draw_integers(hash_keys(key ^ 1), 1 << 31, s).argsort(dim=1)
        _assign(obs, (torch.arange(n, device=obs.device)[:, None], order[:, : self.frames]), 0)


@dataclass(frozen=True)
class CorruptionConfig:
    """Which corruption, and its fields."""

    corruption: str = "none"
    """none, patch, zero_frames or patch+zero_frames."""
    corruption_mode: Mode = "resample"
    """resample: drawn anew whenever a row enters a batch, as in the paper; emission: a row always looks the same."""
    patch_size: int = 16
    """Side of a patch in pixels."""
    patch_count: int = 1
    """Patches a frame."""
    patch_fill: int = 0
    """Pixel value inside a patch."""
    patch_shared: bool = False
    """Whether the frames of a stack share their patches."""
    zeroed_frames: int = 2
    """Frames of a stack that `zero_frames` blanks."""


def _patch(config: CorruptionConfig) -> Stage:
    return Patch(config.patch_size, config.patch_count, config.patch_fill, config.patch_shared)


def _zero_frames(config: CorruptionConfig) -> Stage:
    return ZeroFrames(config.zeroed_frames)


STAGES = {"patch": _patch, "zero_frames": _zero_frames}
"""Every stage by name. A corruption's name joins its stages with `+`, in the order they are applied."""
CORRUPTIONS = ("none", "patch", "zero_frames", "patch+zero_frames")
"""The benchmark's settings."""


class Corruption:
    """A sequence of stages applied to frame stacks."""

    def __init__(self, name: str, stages: list[Stage]) -> None:
        self.name = name
        self._stages = stages

    def __call__(self, obs: Tensor, key: Tensor) -> Tensor:
        """Corrupted copy of a batch.

        Args:
            obs: (..., C, H, W) uint8, C = 3 * stacked frames.
            key: (...,) int64 on the same device, one a stack; equal keys give equal masks.

        Returns:
            uint8 like `obs`.
        """
        return self.apply_(obs.clone(memory_format=torch.contiguous_format), key) if self._stages else obs

    def apply_(self, obs: Tensor, key: Tensor) -> Tensor:
        """The same in place, for a contiguous batch that is the caller's own."""
        stacks = obs.view(-1, obs.shape[-3] // _CHANNELS, _CHANNELS, *obs.shape[-2:])
        for number, stage in enumerate(self._stages):
            stage(stacks, derive_keys(number, key.reshape(-1)))
        return obs


def make_corruption(config: CorruptionConfig | str) -> Corruption:
    """Build a corruption from its config, or from its name with default fields; an unknown name or a field
    out of range raises UserError."""
    if isinstance(config, str):
        config = CorruptionConfig(config)
    names = [] if config.corruption == "none" else config.corruption.split("+")
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        raise UserError(f"unknown corruption {config.corruption!r}: choose one of {', '.join(CORRUPTIONS)}")
    refuse_outside(config, patch_size=1, patch_count=1, patch_fill=(0, 255), zeroed_frames=1)
    return Corruption(config.corruption, [STAGES[name](config) for name in names])


class BatchCorruption:
    """A corruption with its source of keys, for batches of a data set.

    The keys come from a stream of their own, so that two methods with the same seed see identical masks.
    """

    def __init__(self, config: CorruptionConfig, seed: int) -> None:
        self._corruption = make_corruption(config)
        self._mode = config.corruption_mode
        self.stream = KeyStream(seed)

    def __call__(self, obs: Tensor, row_key: Tensor) -> Tensor:
        """Corrupt, in place, contiguous (..., C, H, W) uint8 stacks whose rows are named by (...,) int64 `row_key`."""
        if self._mode == "emission":
            return self._corruption.apply_(obs, derive_keys(self.stream.seed, row_key))
        return self._corruption.apply_(obs, self.stream.take(row_key.shape, obs.device))
