"""Observations by one pass over their pixels, for a GPU: of which frame, shifted how far, hidden or not.

`drawn` gives a few numbers for every stack, `painted` every pixel by arithmetic on indices: a few kernels, if compiled.
Masks, shifts and pixels are those of `Corruption.apply_` and `augmentation.random_shift`, which a CPU runs.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from vd4rl_pomdp.core.compiling import compiled_on_gpu
from vd4rl_pomdp.corruptions.augmentation import draw_offset
from vd4rl_pomdp.corruptions.keys import derive_keys, hash_keys


@runtime_checkable
class Hiding(Protocol):
    """A stage that can also say of a single pixel whether it hides it; others are applied to whole stacks."""

    @property
    def hidden_value(self) -> int:
        """Value of the pixels that it hides, 0 to 255."""

    def places(self, key: Tensor, number: Tensor, height: int, width: int) -> Tensor:
        """Where it hides pixels: (N, K, ...) numbers of whatever kind `hides` reads.

        Args:
            key: (N,) int64, what to draw from.
            number: (N, K) int64 place of each frame in its stack.
            height: of a frame.
            width: of a frame.
        """

    def hides(self, places: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Whether pixels are hidden: (N, K, H, W) bool, given `places`, (H, 1) rows and (W,) columns, int64."""


def tells_pixels(stage: Any) -> bool:
    """Whether a stage is `Hiding`, and not by inheritance from one that does something else to frames."""
    kinds = type(stage).__mro__
    tells, does = (
        next((i for i, kind in enumerate(kinds) if name in vars(kind)), len(kinds)) for name in ("hides", "__call__")
    )
    return isinstance(stage, Hiding) and tells <= does


class StackDraws(NamedTuple):
    """What is drawn for N stacks of S frames."""

    offset: Tensor | None
    """(N, 2) int64, as `augmentation.draw_offset` has it; None: nothing is shifted."""
    kept: Tensor | None
    """(N, S) bool: frames that are not dropped; None: all are kept."""
    places: tuple[Tensor, ...]
    """One of each stage."""


def drop_order(drop: Any, key: Tensor, stages: int, stack: int) -> Tensor:
    """`FrameDrop.order` (N, stack) of stacks with (N,) keys, after so many stages."""
    # A stream beside those of the stages, so that which frames are dropped tells nothing of where patches are.
    return drop.order(hash_keys(derive_keys(stages, key) ^ 1), stack)


@compiled_on_gpu(training=True)
def drawn(
    stages: tuple[Any, ...],
    drop: Any,
    dropped: int,
    pad: int,
    key: Tensor,
    shift_key: Tensor,
    stack: int,
    size: tuple[int, int],
) -> StackDraws:
    """Draws for stacks of `stack` frames.

    Args:
        stages: each `Hiding`.
        drop: a `FrameDrop`, None for none.
        dropped: frames of a stack that it drops.
        pad: largest shift.
        key: (N,) int64, what the corruption is drawn from.
        shift_key: (M,) int64, what the shifts are drawn from, each for N / M stacks that follow one another.
        stack: frames S of a stack.
        size: height and width of a frame.
    """
    offset = kept = None
    if pad:
        offset = draw_offset(shift_key, pad).repeat_interleave(len(key) // len(shift_key), 0)
    if dropped:
        draws, place = drop_order(drop, key, len(stages), stack), torch.arange(stack, device=key.device)
        one, other = draws[:, :, None], draws[:, None]
        # ranks by comparison, equal draws in order: what sorting gives
        before = (other < one) | ((other == one) & (place < place[:, None]))
        kept = before.sum(2) >= dropped
    number = torch.arange(stack, device=key.device).expand(len(key), stack)
    places = tuple(stage.places(derive_keys(n, key), number, *size) for n, stage in enumerate(stages))
    return StackDraws(offset, kept, places)


@compiled_on_gpu(training=True)
def painted(
    stages: tuple[Any, ...],
    frames: Tensor,
    index: Tensor,
    offset: Tensor | None,
    kept: Tensor | None,
    places: tuple[Tensor, ...],
) -> Tensor:
    """Stacks (N, S * C, H, W) uint8, given what was `drawn` for them.

    Args:
        stages: each `Hiding`.
        frames: (R, C, H, W) uint8.
        index: (N, S) int64 of the frames in each stack.
        offset, kept, places: see `StackDraws`.
    """
    _, channels, height, width = frames.shape
    y, x = torch.arange(height, device=frames.device), torch.arange(width, device=frames.device)
    row, column = y.expand(len(index), height), x.expand(len(index), width)
    if offset is not None:
        row, column = (row + offset[:, :1]).clamp(0, height - 1), (column + offset[:, 1:]).clamp(0, width - 1)
    channel = torch.arange(channels, device=frames.device)[:, None, None]
    pixels = frames[index[:, :, None, None, None], channel, row[:, None, None, :, None], column[:, None, None, None, :]]
    for stage, place in zip(stages, places, strict=True):
        pixels = torch.where(stage.hides(place, y[:, None], x)[:, :, None], stage.hidden_value, pixels)
    if kept is not None:
        pixels = torch.where(kept[:, :, None, None, None], pixels, 0)
    return pixels.flatten(1, 2)
