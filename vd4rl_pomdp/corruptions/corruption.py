"""What makes the pixels a POMDP (Wu et al. 2024, section 4.2): patches and zeroed frames of the stack.

A corruption is a pure function of a batch of frame stacks and their keys. The same object serves batches of a data set
(on any device) and the environment at evaluation, and equal keys give equal masks on both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from vd4rl_pomdp.corruptions.keys import KeyStream, derive_keys, draw_integers, draw_numbered, hash_keys
from vd4rl_pomdp.errors import UserError, refuse_outside
from vd4rl_pomdp.seeding import stream_seed
from vd4rl_pomdp.tasks import FRAME_SIZE, FRAME_STACK

Mode = Literal["resample", "emission"]
_CHANNELS = 3


class Stage(Protocol):
    """One step of a corruption, applied to the frames that are not zeroed."""

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        """Change frames in place.

        Args:
            frames: (N, K, 3, H, W) uint8, K frames of each stack.
            key: (N,) int64, what to draw from.
            number: (N, K) int64 place of each frame in its stack.
        """


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

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        """See `Stage`."""
        n, k, _, height, width = frames.shape
        if self.size > min(height, width):
            raise UserError(
                f"patch size {self.size} exceeds the image ({height}x{width}): choose a smaller --patch-size"
            )
        square = torch.arange(self.count, device=key.device)
        draw = (0 if self.shared else number[..., None] * self.count) + square.expand(n, k, self.count)
        top = draw_numbered(key, height - self.size + 1, draw)
        left = draw_numbered(hash_keys(key), width - self.size + 1, draw)
        squares = frames.unfold(3, self.size, 1).unfold(4, self.size, 1)
        sample = torch.arange(n, device=key.device)[:, None, None]
        frame = torch.arange(k, device=key.device)[:, None]
        _assign(squares.movedim(2, 4), (sample, frame, top, left), self.fill)


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


STAGES = {"patch": _patch}
"""Every stage by name. A corruption's name joins its stages with `+`, in the order they are applied; zero_frames, which
drops whole frames, may end it."""
CORRUPTIONS = ("none", "patch", "zero_frames", "patch+zero_frames")
"""The benchmark's settings."""


class Corruption:
    """Stages that change frames, and a number of frames of each stack, chosen uniformly, that become 0.

    The newest frame may be among the zeroed ones.
    """

    def __init__(self, name: str, stages: list[Stage], zeroed: int = 0) -> None:
        self.name = name
        self._stages, self._zeroed = stages, zeroed
        self._nothing = not stages and not zeroed

    def __call__(self, obs: Tensor, key: Tensor) -> Tensor:
        """Corrupted copy of a batch.

        Args:
            obs: (..., C, H, W) uint8, C = 3 * stacked frames.
            key: (...,) int64 on the same device, one a stack; equal keys give equal masks.

        Returns:
            uint8 like `obs`; `obs` itself where there is nothing to do.
        """
        if self._nothing:
            return obs
        return self.apply_(obs.clone(memory_format=torch.contiguous_format), key)

    def apply_(self, obs: Tensor, key: Tensor) -> Tensor:
        """The same in place, for a contiguous batch that is the caller's own."""
        if self._nothing:
            return obs
        stacks, key = obs.view(-1, obs.shape[-3] // _CHANNELS, _CHANNELS, *obs.shape[-2:]), key.reshape(-1)
        kept = self.kept(key, stacks.shape[1])
        if not self._zeroed:
            self.change_(stacks, key, kept)
            return obs
        sample = torch.arange(len(stacks), device=obs.device)[:, None]
        frames = stacks[sample, kept]
        self.change_(frames, key, kept)
        stacks.zero_()[sample, kept] = frames
        return obs

    def kept(self, key: Tensor, stack: int) -> Tensor:
        """Numbers of the frames that are not zeroed, (N, K) int64, in stacks of `stack` frames with (N,) int64 keys."""
        if not self._zeroed:
            return torch.arange(stack, device=key.device).expand(len(key), stack)
        if self._zeroed > stack:
            raise UserError(f"cannot zero {self._zeroed} of {stack} stacked frames: choose a smaller --zeroed-frames")
        key = hash_keys(derive_keys(len(self._stages), key) ^ 1)
        return draw_integers(key, 1 << 31, stack).argsort(dim=1)[:, self._zeroed :]

    def change_(self, frames: Tensor, key: Tensor, kept: Tensor) -> None:
        """Apply the stages, in place, to the (N, K, 3, H, W) frames that (N, K) `kept` names."""
        for number, stage in enumerate(self._stages):
            stage(frames, derive_keys(number, key), kept)


def make_corruption(config: CorruptionConfig | str) -> Corruption:
    """Build a corruption from its config, or from its name with default fields; an unknown name or a field
    out of range raises UserError."""
    if isinstance(config, str):
        config = CorruptionConfig(config)
    names = [] if config.corruption == "none" else config.corruption.split("+")
    zeroes = names[-1:] == ["zero_frames"]
    stages = names[:-1] if zeroes else names
    if any(name not in STAGES for name in stages):
        raise UserError(f"unknown corruption {config.corruption!r}: choose one of {', '.join(CORRUPTIONS)}")
    refuse_outside(config, patch_size=1, patch_count=1, patch_fill=(0, 255), zeroed_frames=1)
    return Corruption(config.corruption, [STAGES[name](config) for name in stages], config.zeroed_frames * zeroes)


def check_corruption(config: CorruptionConfig, size: int = FRAME_SIZE) -> None:
    """Raise UserError for a corruption that does not fit stacks of size x size pixels, before any is corrupted."""
    stack = torch.zeros(1, _CHANNELS * FRAME_STACK, size, size, dtype=torch.uint8)
    make_corruption(config)(stack, torch.zeros(1, dtype=torch.int64))


class BatchCorruption:
    """A corruption with its source of keys, for batches of a data set.

    The keys come from a stream of their own, so that two methods with the same seed see identical masks. `name` tells
    the streams of a run apart; under `emission` all of them share one, since a row always looks the same.
    """

    def __init__(self, config: CorruptionConfig, seed: int, *name: str | int) -> None:
        self._emission = config.corruption_mode == "emission"
        self.corruption = make_corruption(config)
        self.stream = KeyStream(stream_seed(seed, "corruption", *(["emission"] if self._emission else name)))

    def __call__(self, obs: Tensor, row_key: Tensor) -> Tensor:
        """Corrupt, in place, contiguous (..., C, H, W) uint8 stacks whose rows are named by (...,) int64 `row_key`."""
        return self.corruption.apply_(obs, self.keys(row_key))

    def keys(self, row_key: Tensor) -> Tensor:
        """What the next batch's rows, named by (...,) int64 `row_key`, are corrupted by: (...,) int64."""
        if self._emission:
            return derive_keys(self.stream.seed, row_key)
        return self.stream.take(row_key.shape, row_key.device)
