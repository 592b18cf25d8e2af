"""Corruptions that turn the pixels into a POMDP: patches and zeroed frames (Wu et al. 2024, section 4.2), truncation.

A corruption is a pure function of a batch of frame stacks and random keys. Training (on any device) and evaluation in
the environment use the same object, and equal keys give equal masks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, Protocol, Self, get_args

import torch
from torch import Tensor

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_unknown
from vd4rl_pomdp.core.options import Limits, Options, flat, refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.core.streams import stream_seed
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.corruptions.fused import drawn, drop_order, painted, tells_pixels
from vd4rl_pomdp.corruptions.keys import DRAWS, KeyStream, derive_keys, draw_integers, draw_numbered, hash_keys

Mode = Literal["resample", "emission"]
_CHANNELS = 3


class Stage(Protocol):
    """One step of a corruption: a dataclass of options that modifies frames. It does not see frames that are zeroed.

    A stage that also implements `fused.Hiding` is fused with the others into one pass on a GPU.
    """

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        """Change frames in place.

        Args:
            frames: (N, K, 3, H, W) uint8, K frames of each stack.
            key: (N,) int64 random keys.
            number: (N, K) int64 index of each frame in its stack, 0 the oldest.
        """


@dataclass(frozen=True)
class Patch(Options):
    """Fills squares at uniformly random positions of every frame with one value."""

    patch_size: int = 16
    """Side length of a patch in pixels."""
    patch_count: int = 1
    """Patches per frame."""
    patch_fill: int = 0
    """Pixel value inside a patch."""
    patch_shared: bool = False
    """Put the patches at the same positions in all frames of a stack."""

    summary: ClassVar[str] = "squares at uniformly random places in every frame are set to one value"
    limits: ClassVar[Limits] = {"patch_size": 1, "patch_count": (1, 1000), "patch_fill": (0, 255)}

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        n, k, _, height, width = frames.shape
        top, left = self._corners(key, number, height, width)
        # A view of every possible square, indexed by its corner: writing to it writes to the frames.
        squares = frames.unfold(3, self.patch_size, 1).unfold(4, self.patch_size, 1)
        sample = torch.arange(n, device=key.device)[:, None, None]
        frame = torch.arange(k, device=key.device)[:, None]
        target, index = squares.movedim(2, 4), (sample, frame, top, left)
        if hardware.in_host_memory(target):  # on a CPU numpy is several times faster
            target.numpy()[tuple(part.numpy() for part in index)] = self.patch_fill
        else:  # target[index] = value would copy the value from the CPU and synchronise
            target.index_put_(index, torch.full((), self.patch_fill, dtype=target.dtype, device=target.device))

    @property
    def hidden_value(self) -> int:
        return self.patch_fill

    def places(self, key: Tensor, number: Tensor, height: int, width: int) -> Tensor:
        """Upper left corners (N, K, patches, 2); see `Hiding`."""
        return torch.stack(self._corners(key, number, height, width), -1)

    def hides(self, places: Tensor, y: Tensor, x: Tensor) -> Tensor:
        top, left = places[..., None, None].unbind(3)
        inside = (top <= y) & (y < top + self.patch_size) & (left <= x) & (x < left + self.patch_size)
        return inside.any(2)

    def _corners(self, key: Tensor, number: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Rows and columns, each (N, K, patches), of the upper left corners."""
        if self.patch_size > min(height, width):
            raise UserError(
                f"patch size {self.patch_size} exceeds the image ({height}x{width}): choose a smaller --patch-size"
            )
        square = torch.arange(self.patch_count, device=key.device).expand(*number.shape, self.patch_count)
        draw = (0 if self.patch_shared else number[..., None] * self.patch_count) + square
        top = draw_numbered(key, height - self.patch_size + 1, draw)
        # Hash the key again, or rows and columns would be the same draws.
        return top, draw_numbered(hash_keys(key), width - self.patch_size + 1, draw)


@dataclass(frozen=True)
class FrameDrop(Options, ABC):
    """Zeroes whole frames of every stack. It must be the last stage of a corruption, since no stage sees these frames.

    The `dropped` frames with the lowest `order` become 0.
    """

    @abstractmethod
    def dropped(self, stack: int) -> int:
        """Number of frames to zero in a stack of `stack` frames; UserError if that is impossible."""

    @abstractmethod
    def order(self, key: Tensor, stack: int) -> Tensor:
        """Priority (N, stack) int64 of each frame, oldest first, from (N,) int64 keys; in ties the older is zeroed."""


@dataclass(frozen=True)
class ZeroFrames(FrameDrop):
    """Zeroes a number of uniformly chosen frames of every stack, which may include the newest."""

    zeroed_frames: int = 2
    """Frames to zero per stack."""
    keep_newest: bool = False
    """Never zero the newest frame: choose among the older ones only."""

    summary: ClassVar[str] = (
        "randomly chosen frames of every stack are set to 0; must come last, as in patch+zero_frames"
    )
    limits: ClassVar[Limits] = {"zeroed_frames": 1}

    def dropped(self, stack: int) -> int:
        if self.zeroed_frames > stack - self.keep_newest:
            newest = " and keep the newest" if self.keep_newest else ""
            raise UserError(
                f"cannot zero {self.zeroed_frames} of {stack} stacked frames{newest}: choose a smaller --zeroed-frames"
            )
        return self.zeroed_frames

    def order(self, key: Tensor, stack: int) -> Tensor:
        """Random priorities, which give a uniform permutation; see `FrameDrop`."""
        draws = draw_integers(key, DRAWS, stack)
        if self.keep_newest:
            draws[:, -1] = DRAWS  # larger than any draw, so never zeroed
        return draws


@dataclass(frozen=True)
class Truncate(FrameDrop):
    """Zeroes all frames of a stack except the newest, or except the oldest, which is two steps old."""

    kept: Literal["newest", "oldest"] = "newest"
    """The frame to keep: newest or oldest."""

    summary: ClassVar[str] = "all frames of every stack except the newest, or the oldest, are set to 0; must come last"

    def check(self) -> None:
        refuse_unknown("--kept", self.kept, ("newest", "oldest"))
        super().check()

    def dropped(self, stack: int) -> int:
        return stack - 1

    def order(self, key: Tensor, stack: int) -> Tensor:
        """Deterministic priorities; see `FrameDrop`."""
        place = torch.arange(stack, device=key.device)
        return (place if self.kept == "newest" else -place).expand(len(key), stack)


def _is_stage(part: Any) -> bool:
    options = isinstance(part, type) and issubclass(part, Options)
    return options and (issubclass(part, FrameDrop) or any("__call__" in vars(kind) for kind in part.__mro__))


def _refuse_stage(name: str, kind: type[Options]) -> None:
    """Raise UserError for a stage with a reserved name or invalid options."""
    if name == "none" or "+" in name:
        raise UserError("'none' and names with '+' are reserved: choose another name")
    refuse_options(kind)


STAGES: Registry[type[Options]] = Registry(
    "corruption",
    {"patch": Patch, "zero_frames": ZeroFrames, "truncate": Truncate},
    _is_stage,
    "a class of vd4rl_pomdp.core.options.Options with the method of a Stage, or a FrameDrop",
    _refuse_stage,
)
"""All stages by name; each is a dataclass of options that is a `Stage` or a `FrameDrop`. A corruption is named by its
stages joined with `+`, in order of application. Other packages add stages through the entry point group
`vd4rl_pomdp.corruptions`."""
CORRUPTIONS = ("none", "patch", "zero_frames", "patch+zero_frames")
"""The paper's corruptions, and none as the fully observed control."""


def _kinds(corruption: str) -> list[type[Options]]:
    """Stage classes of a corruption, such as [Patch, ZeroFrames]; UserError for an unknown or repeated name."""
    names = [] if corruption == "none" else corruption.split("+")
    kinds = [STAGES.named(name) for name in dict.fromkeys(names)]
    if len(kinds) < len(names) or any(issubclass(kind, FrameDrop) for kind in kinds[:-1]):
        last = " or ".join(name for name, kind in STAGES.items() if issubclass(kind, FrameDrop))
        raise UserError(
            f"unknown corruption {corruption!r}: join stages with +, each at most once, with {last} only at the end"
        )
    return kinds


@dataclass(frozen=True)
class CorruptionConfig(Options):
    """A corruption's name, mode and stages with their options; create one with `CorruptionConfig.of`."""

    corruption: str = "none"
    """none, or stages joined by +: patch, zero_frames, truncate, patch+zero_frames, ..."""
    corruption_mode: Mode = "resample"
    """resample: a row gets a new mask whenever it is sampled, as in the paper (with cached features: once per view).
    emission: a row always gets the same mask, in all runs with the same seed."""
    stages: tuple[Options, ...] = ()
    """The stages, one per part of the name."""

    @classmethod
    def of(cls, corruption: str = "none", corruption_mode: Mode = "resample", **options: Any) -> Self:
        """Build a config by name, such as `CorruptionConfig.of("patch+zero_frames", patch_size=32)`.

        UserError for an unknown or repeated name, an option that no stage has, or one that two stages have.
        """
        config = cls.fill({"corruption": corruption, "corruption_mode": corruption_mode} | options)
        known = flat(config)
        for name in (name for name in options if name not in known):
            raise UserError(f"{flag_of(name)} is not read by the corruption {corruption}: leave it out")
        return config

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Build the config from flag values, including those of its stages' options; others are ignored."""
        stages = tuple(kind.fill(values) for kind in _kinds(values.get("corruption", "none")))
        return cls(**{name: values[name] for name in _OWN if name in values}, stages=stages)

    def check(self) -> None:
        """Raise UserError if the stages do not match the name, or for invalid values."""
        if [type(stage) for stage in self.stages] != _kinds(self.corruption):
            raise UserError(
                f"the stages of this config are not those of {self.corruption!r}: create it with "
                f"CorruptionConfig.of({self.corruption!r}, ...)"
            )
        refuse_unknown("corruption mode", self.corruption_mode, get_args(Mode))
        super().check()


_OWN = ("corruption", "corruption_mode")
NO_CORRUPTION = CorruptionConfig()


def corruption_settings(corruption: str) -> set[str]:
    """Names of all settings of a corruption, such as patch_size; stages not installed here are skipped."""
    kinds = (STAGES[name] for name in corruption.split("+") if name in STAGES)
    return {*_OWN, *(field.name for kind in kinds for field in fields(kind))}


class Corruption:
    """A sequence of stages that modify frames, then optionally a `FrameDrop` that zeroes whole frames."""

    def __init__(self, stages: list[Stage], drop: FrameDrop | None = None) -> None:
        self._stages, self._drop = stages, drop
        self._nothing = not stages and drop is None
        self._by_pixel = all(tells_pixels(stage) for stage in stages)

    def __call__(self, obs: Tensor, key: Tensor) -> Tensor:
        """Corrupted copy of (..., C, H, W) uint8 stacks; `obs` itself if the corruption is "none".

        `key` are (...,) int64 on the same device, one per stack; equal keys give equal masks. UserError for others.
        """
        if self._nothing:
            return obs
        return self.apply_(obs.clone(memory_format=torch.contiguous_format), key)

    def apply_(self, obs: Tensor, key: Tensor) -> Tensor:
        """Corrupt a contiguous batch in place; arguments and errors as `__call__`."""
        if self._nothing:
            return obs
        if key.shape != obs.shape[:-3] or key.dtype != torch.int64:
            raise UserError(
                f"keys are {key.dtype} of shape {tuple(key.shape)}: {tuple(obs.shape)} observations need int64 ones of "
                f"shape {tuple(obs.shape[:-3])}, one a stack"
            )
        stacks, key = obs.view(-1, obs.shape[-3] // _CHANNELS, _CHANNELS, *obs.shape[-2:]), key.reshape(-1)
        kept = self.kept(key, stacks.shape[1])
        if self._drop is None:
            self.change_(stacks, key, kept)
            return obs
        sample = torch.arange(len(stacks), device=obs.device)[:, None]
        frames = stacks[sample, kept]
        self.change_(frames, key, kept)
        stacks.zero_()[sample, kept] = frames
        return obs

    def paint(self, frames: Tensor, index: Tensor, key: Tensor, shift_key: Tensor, pad: int) -> Tensor | None:
        """Gather, shift and corrupt frames in one fused pass; arguments as of `fused.drawn` and `fused.painted`.

        Returns:
            (N, S * C, H, W) uint8; None if nothing changes, or if a stage does not implement `Hiding`.
        """
        if not self._by_pixel or not len(index) or (self._nothing and not pad):
            return None
        stages, stack, size = tuple(self._stages), index.shape[1], (frames.shape[-2], frames.shape[-1])
        dropped = self._drop.dropped(stack) if self._drop else 0
        made = drawn(stages, self._drop, dropped, pad, key, shift_key, stack, size)
        return painted(stages, frames, index, *made)

    def kept(self, key: Tensor, stack: int) -> Tensor:
        """Indices (N, K) int64 of the frames that are not zeroed, in stacks of `stack` frames with (N,) int64 keys."""
        if self._drop is None:
            return torch.arange(stack, device=key.device).expand(len(key), stack)
        dropped = self._drop.dropped(stack)
        return drop_order(self._drop, key, len(self._stages), stack).argsort(dim=1, stable=True)[:, dropped:]

    def change_(self, frames: Tensor, key: Tensor, kept: Tensor) -> None:
        """Apply the stages in place to (N, K, 3, H, W) frames, whose indices in their stacks are `kept` (N, K)."""
        for number, stage in enumerate(self._stages):
            stage(frames, derive_keys(number, key), kept)


def make_corruption(config: CorruptionConfig | str) -> Corruption:
    """Build a corruption from its config, or from its name with default options; UserError if either is invalid."""
    if isinstance(config, str):
        config = CorruptionConfig.of(config)
    config.check()
    stages = [stage for stage in config.stages if not isinstance(stage, FrameDrop)]
    drop = config.stages[-1] if config.stages and isinstance(config.stages[-1], FrameDrop) else None
    return Corruption(stages, drop)  # type: ignore[arg-type]


def check_corruption_fits(config: CorruptionConfig, size: int = FRAME_SIZE) -> None:
    """Raise UserError if a corruption cannot be applied to size x size frames, such as a patch larger than those."""
    stack = torch.zeros(1, _CHANNELS * FRAME_STACK, size, size, dtype=torch.uint8)
    make_corruption(config)(stack, torch.zeros(1, dtype=torch.int64))


class BatchCorruption:
    """A corruption with a stream of random keys, for batches of a data set.

    The stream is separate from the method's, so that two methods with the same seed see identical masks. `name`
    distinguishes the streams of a run. In `emission` mode they share one, so that a row always gets the same mask.
    """

    def __init__(self, config: CorruptionConfig | str, seed: int, *name: str | int) -> None:
        config = CorruptionConfig.of(config) if isinstance(config, str) else config
        self._emission = config.corruption_mode == "emission"
        self.corruption = make_corruption(config)
        self.stream = KeyStream(stream_seed(seed, "corruption", *(["emission"] if self._emission else name)))

    def __call__(self, obs: Tensor, row_key: Tensor) -> Tensor:
        """Corrupt contiguous (..., C, H, W) uint8 stacks in place; `row_key` (...,) int64 identifies their rows."""
        return self.corruption.apply_(obs, self.keys(row_key))

    def keys(self, row_key: Tensor) -> Tensor:
        """Corruption keys (...,) int64 for the next batch; `row_key` (...,) int64 identifies its rows."""
        if self._emission:
            return derive_keys(self.stream.seed, row_key)
        return self.stream.take(row_key.shape, row_key.device)
