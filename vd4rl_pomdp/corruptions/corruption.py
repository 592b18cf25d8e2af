"""What makes the pixels a POMDP: patches and zeroed frames (Wu et al. 2024, section 4.2), stacks of one frame.

A corruption is a pure function of a batch of frame stacks and their keys. The same object serves batches of a data set
(on any device) and the environment at evaluation, and equal keys give equal masks on both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, Protocol, Self, get_args

import torch
from torch import Tensor

from vd4rl_pomdp.core import buffers
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_unknown
from vd4rl_pomdp.core.options import Limits, Options, flat, refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.core.seeding import stream_seed
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.corruptions.fused import drawn, drop_order, painted, tells_pixels
from vd4rl_pomdp.corruptions.keys import DRAWS, KeyStream, derive_keys, draw_integers, draw_numbered, hash_keys

Mode = Literal["resample", "emission"]
_CHANNELS = 3


class Stage(Protocol):
    """One step of a corruption, applied to the frames that are not zeroed; a dataclass of its own options.

    With the methods of `fused.Hiding`, too, a GPU needs no pass of its own for it.
    """

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        """Change frames in place.

        Args:
            frames: (N, K, 3, H, W) uint8, K frames of each stack.
            key: (N,) int64, what to draw from.
            number: (N, K) int64 place of each frame in its stack.
        """


@dataclass(frozen=True)
class Patch(Options):
    """Squares of every frame, at uniformly random places, take one value."""

    patch_size: int = 16
    """Side of a patch in pixels."""
    patch_count: int = 1
    """Patches a frame."""
    patch_fill: int = 0
    """Pixel value inside a patch."""
    patch_shared: bool = False
    """Whether the frames of a stack share their patches."""

    summary: ClassVar[str] = "squares of every frame, at uniformly random places, take one value"
    limits: ClassVar[Limits] = {"patch_size": 1, "patch_count": (1, 1000), "patch_fill": (0, 255)}

    def __call__(self, frames: Tensor, key: Tensor, number: Tensor) -> None:
        """See `Stage`."""
        n, k, _, height, width = frames.shape
        top, left = self._corners(key, number, height, width)
        # Every square of the frames by its corner, as a view: writing into it writes into the frames.
        squares = frames.unfold(3, self.patch_size, 1).unfold(4, self.patch_size, 1)
        sample = torch.arange(n, device=key.device)[:, None, None]
        frame = torch.arange(k, device=key.device)[:, None]
        target, index = squares.movedim(2, 4), (sample, frame, top, left)
        if buffers.in_host_memory(target):  # where numpy is several times as fast
            target.numpy()[tuple(part.numpy() for part in index)] = self.patch_fill
        else:  # as an assignment, the value would come from the CPU, and that be waited for
            target.index_put_(index, torch.full((), self.patch_fill, dtype=target.dtype, device=target.device))

    @property
    def hidden_value(self) -> int:
        """See `Hiding`."""
        return self.patch_fill

    def places(self, key: Tensor, number: Tensor, height: int, width: int) -> Tensor:
        """See `Hiding`: (N, K, patches, 2) upper left corners."""
        return torch.stack(self._corners(key, number, height, width), -1)

    def hides(self, places: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """See `Hiding`."""
        top, left = places[..., None, None].unbind(3)
        inside = (top <= y) & (y < top + self.patch_size) & (left <= x) & (x < left + self.patch_size)
        return inside.any(2)

    def _corners(self, key: Tensor, number: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Rows and columns (N, K, patches) of the upper left corners."""
        if self.patch_size > min(height, width):
            raise UserError(
                f"patch size {self.patch_size} exceeds the image ({height}x{width}): choose a smaller --patch-size"
            )
        square = torch.arange(self.patch_count, device=key.device)
        draw = (0 if self.patch_shared else number[..., None] * self.patch_count) + square.expand(
            *number.shape, self.patch_count
        )
        top = draw_numbered(key, height - self.patch_size + 1, draw)
        # Hashed once more: from the key itself rows and columns would draw the same.
        return top, draw_numbered(hash_keys(key), width - self.patch_size + 1, draw)


@dataclass(frozen=True)
class FrameDrop(Options, ABC):
    """Whole frames of every stack become 0. No stage sees them any more: it may only end a corruption's name."""

    @abstractmethod
    def dropped(self, stack: int) -> int:
        """How many frames of a stack of `stack` become 0; raises UserError where it cannot be."""

    @abstractmethod
    def order(self, key: Tensor, stack: int) -> Tensor:
        """In which order they do: (N, stack) int64, the frame of the lowest number first; (N,) int64 keys to draw from.

        A frame's place in its stack is that in the row, the newest last; of equal numbers the older frame comes first.
        """


@dataclass(frozen=True)
class ZeroFrames(FrameDrop):
    """Frames of every stack, chosen uniformly, become 0, the newest perhaps among them."""

    zeroed_frames: int = 2
    """Frames of a stack that are blanked."""
    keep_newest: bool = False
    """Whether they are chosen among the older frames alone, so that the newest is always seen."""

    summary: ClassVar[str] = (
        "frames of every stack, chosen uniformly, become 0; it must come last, as in patch+zero_frames"
    )
    limits: ClassVar[Limits] = {"zeroed_frames": 1}

    def dropped(self, stack: int) -> int:
        """See `FrameDrop`."""
        if self.zeroed_frames > stack - self.keep_newest:
            kept = " and keep the newest" if self.keep_newest else ""
            raise UserError(
                f"cannot zero {self.zeroed_frames} of {stack} stacked frames{kept}: choose a smaller --zeroed-frames"
            )
        return self.zeroed_frames

    def order(self, key: Tensor, stack: int) -> Tensor:
        """See `FrameDrop`: numbers sorted by random draws are a uniform permutation."""
        draws = draw_integers(key, DRAWS, stack)
        if self.keep_newest:
            draws[:, -1] = DRAWS  # above all draws
        return draws


@dataclass(frozen=True)
class Truncate(FrameDrop):
    """All frames of a stack but one become 0: the newest, or the oldest, which was seen two steps before."""

    kept: Literal["newest", "oldest"] = "newest"
    """The frame of a stack that stays: newest or oldest."""

    summary: ClassVar[str] = "all frames of every stack but the newest, or the oldest, become 0; it must come last"

    def check(self) -> None:
        """Raise UserError for another frame."""
        refuse_unknown("--kept", self.kept, ("newest", "oldest"))
        super().check()

    def dropped(self, stack: int) -> int:
        """See `FrameDrop`."""
        return stack - 1

    def order(self, key: Tensor, stack: int) -> Tensor:
        """See `FrameDrop`: nothing is drawn."""
        place = torch.arange(stack, device=key.device)
        return (place if self.kept == "newest" else -place).expand(len(key), stack)


def _is_stage(part: Any) -> bool:
    changes = isinstance(part, type) and issubclass(part, Options) and any("__call__" in vars(c) for c in part.__mro__)
    return changes or _drops(part)


def _drops(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, FrameDrop)


def _refuse_stage(name: str, kind: type[Options]) -> None:
    """Raise UserError for a stage that no corruption's name could tell of, or whose options cannot work."""
    if name == "none" or "+" in name:
        raise UserError("'none' and names with '+' mean no stage, or several: choose another name")
    refuse_options(kind)


STAGES: Registry[type[Options]] = Registry(
    "corruption",
    {"patch": Patch, "zero_frames": ZeroFrames, "truncate": Truncate},
    _is_stage,
    "a class of vd4rl_pomdp.core.options.Options with the method of a Stage, or a FrameDrop",
    _refuse_stage,
)
"""Every stage by name: a dataclass of its options that is a `Stage`, or a `FrameDrop`. A corruption's name joins its
stages with `+`, in the order in which they are applied. Packages offer theirs in the group of entry points
`vd4rl_pomdp.corruptions`."""
CORRUPTIONS = ("none", "patch", "zero_frames", "patch+zero_frames")
"""The paper's settings, and the fully observed control."""


def _kinds(corruption: str) -> list[type[Options]]:
    """Classes of a corruption's stages; an unknown or a repeated name raises UserError."""
    names = [] if corruption == "none" else corruption.split("+")
    kinds = [STAGES.named(name) for name in dict.fromkeys(names)]
    if len(kinds) < len(names) or any(map(_drops, kinds[:-1])):
        last = " or ".join(name for name, kind in STAGES.items() if _drops(kind))
        raise UserError(
            f"unknown corruption {corruption!r}: a name joins stages by +, each once, and {last} may only end it"
        )
    return kinds


@dataclass(frozen=True)
class CorruptionConfig(Options):
    """Which corruption, and its stages with their options; `of` makes one from names and values."""

    corruption: str = "none"
    """none, or names of stages joined by +: patch, zero_frames, truncate, patch+zero_frames, ..."""
    corruption_mode: Mode = "resample"
    """resample: drawn anew whenever a row enters a batch, as in the paper (where features are cached: once a view);
    emission: a row is hidden in the same way each time it is read, in all runs of one seed."""
    stages: tuple[Options, ...] = ()
    """One for every part of the name."""

    @classmethod
    def of(cls, corruption: str = "none", corruption_mode: Mode = "resample", **options: Any) -> Self:
        """A corruption by name.

        Args:
            corruption: names of stages, joined by `+`.
            corruption_mode: see the field.
            options: values of the stages' options by name.

        Raises:
            UserError: an unknown or a repeated name, an option that no stage reads, or one that two of them have.
        """
        config = cls.fill({"corruption": corruption, "corruption_mode": corruption_mode} | options)
        known = flat(config)
        for name in (name for name in options if name not in known):
            raise UserError(f"{flag_of(name)} is not read by the corruption {corruption}: leave it out")
        return config

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """The corruption that many values name, with its stages' options among them."""
        stages = tuple(kind.fill(values) for kind in _kinds(values.get("corruption", "none")))
        return cls(**{name: values[name] for name in _OWN if name in values}, stages=stages)

    def check(self) -> None:
        """Raise UserError for stages that are not the name's, and for values that cannot work."""
        if [type(stage) for stage in self.stages] != _kinds(self.corruption):
            raise UserError(
                f"this config has other stages than {self.corruption!r} names, so it would do other things: make it by "
                f"CorruptionConfig.of({self.corruption!r}, ...)"
            )
        refuse_unknown("corruption mode", self.corruption_mode, get_args(Mode))
        super().check()


_OWN = ("corruption", "corruption_mode")
NO_CORRUPTION = CorruptionConfig()


def corruption_settings(corruption: str) -> set[str]:
    """Names of the settings that say how a corruption hides pixels, without those of stages that are not here."""
    kinds = (STAGES[name] for name in corruption.split("+") if name in STAGES)
    return {*_OWN, *(field.name for kind in kinds for field in fields(kind))}


class Corruption:
    """Stages that change frames, and what makes whole frames of each stack 0."""

    def __init__(self, stages: list[Stage], drop: FrameDrop | None = None) -> None:
        self._stages, self._drop = stages, drop
        self._nothing = not stages and drop is None
        self._by_pixel = all(tells_pixels(stage) for stage in stages)

    def __call__(self, obs: Tensor, key: Tensor) -> Tensor:
        """Corrupted copy of a batch.

        Args:
            obs: (..., C, H, W) uint8, C = 3 * stacked frames.
            key: (...,) int64 on the same device, one a stack; equal keys give equal masks.

        Returns:
            uint8 like `obs`; `obs` itself where there is nothing to do.

        Raises:
            UserError: keys of another shape or dtype.
        """
        if self._nothing:
            return obs
        return self.apply_(obs.clone(memory_format=torch.contiguous_format), key)

    def apply_(self, obs: Tensor, key: Tensor) -> Tensor:
        """The same in place, for a contiguous batch that is the caller's own."""
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
        """Frames gathered, shifted and corrupted in one pass.

        Args:
            frames: (R, C, H, W) uint8.
            index: (N, S) int64 of the frames of each stack.
            key: (N,) int64, one a stack.
            shift_key: (M,) int64, each for N / M stacks that follow one another.
            pad: largest shift.

        Returns:
            (N, S * C, H, W) uint8; None where there is nothing to change, or a stage that only knows whole stacks.
        """
        if not self._by_pixel or not len(index) or (self._nothing and not pad):
            return None
        stages, stack, size = tuple(self._stages), index.shape[1], (frames.shape[-2], frames.shape[-1])
        dropped = self._drop.dropped(stack) if self._drop else 0
        made = drawn(stages, self._drop, dropped, pad, key, shift_key, stack, size)
        return painted(stages, frames, index, *made)

    def kept(self, key: Tensor, stack: int) -> Tensor:
        """Numbers of the frames that are not zeroed, (N, K) int64, in stacks of `stack` frames with (N,) int64 keys."""
        if self._drop is None:
            return torch.arange(stack, device=key.device).expand(len(key), stack)
        dropped = self._drop.dropped(stack)
        return drop_order(self._drop, key, len(self._stages), stack).argsort(dim=1)[:, dropped:]

    def change_(self, frames: Tensor, key: Tensor, kept: Tensor) -> None:
        """Apply the stages, in place, to the (N, K, 3, H, W) frames that (N, K) `kept` names."""
        for number, stage in enumerate(self._stages):
            stage(frames, derive_keys(number, key), kept)


def make_corruption(config: CorruptionConfig | str) -> Corruption:
    """Build a corruption from its config, or from its name with default options; an unknown name or a field
    out of range raises UserError."""
    if isinstance(config, str):
        config = CorruptionConfig.of(config)
    config.check()
    stages = [stage for stage in config.stages if not isinstance(stage, FrameDrop)]
    drop = config.stages[-1] if config.stages and isinstance(config.stages[-1], FrameDrop) else None
    return Corruption(stages, drop)  # type: ignore[arg-type]


def check_corruption_fits(config: CorruptionConfig, size: int = FRAME_SIZE) -> None:
    """Raise UserError for a corruption that does not fit stacks of size x size pixels, before any is corrupted."""
    stack = torch.zeros(1, _CHANNELS * FRAME_STACK, size, size, dtype=torch.uint8)
    make_corruption(config)(stack, torch.zeros(1, dtype=torch.int64))


class BatchCorruption:
    """A corruption with its source of keys, for batches of a data set.

    The keys come from a stream of their own, so that two methods with the same seed see identical masks. `name` tells
    the streams of a run apart; under `emission` all of them share one, so that the same of a row is hidden.
    """

    def __init__(self, config: CorruptionConfig | str, seed: int, *name: str | int) -> None:
        config = CorruptionConfig.of(config) if isinstance(config, str) else config
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
