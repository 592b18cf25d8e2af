"""Gather, shift and corrupt frames in one fused pass over the pixels, for a GPU.

`drawn` draws shift, dropped frames and patch positions of every stack; `painted` computes every pixel from them by
index arithmetic. Compiled, that is a few kernels. The result equals the CPU's `random_shift` and `Corruption.apply_`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from vd4rl_pomdp.core.hardware import compiled_on_gpu
from vd4rl_pomdp.corruptions.augmentation import draw_offset
from vd4rl_pomdp.corruptions.keys import derive_keys, hash_keys


@runtime_checkable
class Hiding(Protocol):
    """A stage that can compute its mask pixel by pixel, so that it can be fused; others run on whole stacks."""

    @property
    def hidden_value(self) -> int:
        """Value of hidden pixels, 0 to 255."""

    def places(self, key: Tensor, number: Tensor, height: int, width: int) -> Tensor:
        """Draw the parameters of the masks, (N, K, ...) in any form that `hides` reads, such as patch corners.

        Args:
            key: (N,) int64 random keys.
            number: (N, K) int64 index of each frame in its stack.
            height: frame height.
            width: frame width.
        """

    def hides(self, places: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Mask (N, K, H, W) bool of hidden pixels, from `places` and int64 pixel rows (H, 1) and columns (W,)."""


def tells_pixels(stage: Any) -> bool:
    """Whether a stage is `Hiding`, and `hides` is not outdated by a subclass that overrides only `__call__`."""
    kinds = type(stage).__mro__
    hides, does = (
        next((i for i, kind in enumerate(kinds) if name in vars(kind)), len(kinds)) for name in ("hides", "__call__")
    )
    return isinstance(stage, Hiding) and hides <= does


class StackDraws(NamedTuple):
    """Random draws for N stacks of S frames."""

    offset: Tensor | None
    """(N, 2) int64 shifts from `augmentation.draw_offset`; None: no shift."""
    kept: Tensor | None
    """(N, S) bool, False for zeroed frames; None: all are kept."""
    places: tuple[Tensor, ...]
    """`Hiding.places` of each stage."""


def drop_order(drop: Any, key: Tensor, stages: int, stack: int) -> Tensor:
    """`FrameDrop.order` (N, stack) for (N,) keys, of a drop that follows `stages` stages."""
    # A separate stream from the stages', so that dropped frames and patch positions are independent.
    return drop.order(hash_keys(derive_keys(stages, key) ^ 1), stack)


@compiled_on_gpu
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
    """Draw shifts, dropped frames and masks.

    Args:
        stages: each `Hiding`.
        drop: a `FrameDrop` or None.
        dropped: number of frames per stack that it drops.
        pad: largest shift in pixels.
        key: (N,) int64 corruption keys, one per stack.
        shift_key: (M,) int64 shift keys, each shared by N / M consecutive stacks.
        stack: frames S per stack.
        size: height and width of a frame.
    """
    offset = kept = None
    if pad:
        offset = draw_offset(shift_key, pad).repeat_interleave(len(key) // len(shift_key), 0)
    if dropped:
        draws, place = drop_order(drop, key, len(stages), stack), torch.arange(stack, device=key.device)
        one, other = draws[:, :, None], draws[:, None]
        # each frame's rank, by counting smaller draws; ties by position, like the stable sort on the CPU
        before = (other < one) | ((other == one) & (place < place[:, None]))
        kept = before.sum(2) >= dropped
    number = torch.arange(stack, device=key.device).expand(len(key), stack)
    places = tuple(stage.places(derive_keys(n, key), number, *size) for n, stage in enumerate(stages))
    return StackDraws(offset, kept, places)


@compiled_on_gpu
def painted(
    stages: tuple[Any, ...],
    frames: Tensor,
    index: Tensor,
    offset: Tensor | None,
    kept: Tensor | None,
    places: tuple[Tensor, ...],
) -> Tensor:
    """Compute stacks (N, S * C, H, W) uint8 from the draws of `drawn`.

    Args:
        stages: each `Hiding`.
        frames: (R, C, H, W) uint8.
        index: (N, S) int64, frame numbers of each stack.
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
