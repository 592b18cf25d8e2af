"""Random shift (Kostrikov et al. 2020, arXiv 2004.13649): pad by replicating the border, crop at a random position.

Images are shifted by whole pixels, by gather on a GPU and by copying lines of memory on a CPU. DrQ's grid_sample does
the same with interpolation weights that are 0 and 1 up to float32 rounding: of random pixels 59% are bit-identical, the
others differ by at most 0.004 of 255.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.hardware import BUFFERS
from vd4rl_pomdp.corruptions.keys import draw_integers

Sharing = Literal["window", "observation"]
"""Which images get the same random shift: all observations of a window, or only the frames of one observation."""


def random_shift(obs: Tensor, key: Tensor, pad: int = 4) -> Tensor:
    """Shift (N, ..., H, W) uint8 images by up to `pad` pixels in each direction; 0 returns `obs`.

    `key` are (N,) int64; all images under one leading index get the same shift.
    """
    if pad == 0:
        return obs
    offset = draw_offset(key, pad)
    if not by_lines(obs, pad):
        return shift_by_index(obs, offset)
    out = BUFFERS.take(obs.shape)
    images, shifted = (x.view(len(obs), -1, *obs.shape[-2:]) for x in (obs, out))
    shift_by_lines(images, torch.arange(len(obs)), offset, shifted)
    return out


def draw_offset(key: Tensor, pad: int) -> Tensor:
    """Random shifts (N, 2) int64 as (rows, columns), in -pad..pad, from (N,) int64 keys."""
    return draw_integers(key, 2 * pad + 1, 2) - pad


def by_lines(images: Tensor, pad: int) -> bool:
    """Whether images (N, ..., H, W) can be shifted by `shift_by_lines`."""
    sizes = len(images) > 2 and 0 < pad < min(images.shape[-2:])
    return sizes and hardware.in_host_memory(images) and images.is_contiguous()


def shift_by_index(obs: Tensor, offset: Tensor) -> Tensor:
    """Shift (N, ..., H, W) images by (N, 2) offsets with one gather per pixel: fast on a GPU, slow on a CPU."""
    n, height, width = obs.shape[0], obs.shape[-2], obs.shape[-1]
    y = (offset[:, :1] + torch.arange(height, device=obs.device)).clamp_(0, height - 1)
    x = (offset[:, 1:] + torch.arange(width, device=obs.device)).clamp_(0, width - 1)
    pixel = (y[:, :, None] * width + x[:, None, :]).view(n, 1, height * width)
    images = obs.reshape(n, math.prod(obs.shape[1:-2]), height * width)
    return images.gather(2, pixel.expand_as(images)).view(obs.shape)


def shift_by_lines(images: Tensor, chosen: Tensor, offset: Tensor, out: Tensor) -> None:
    """Write images `chosen` (M,) of (N > 2, planes, H, W), shifted by `offset` (M, 2), to `out`; much faster on a CPU.

    A line shifted by dx is the run of W bytes that starts dx bytes later in memory. The bytes of the neighbouring line
    at its end (or start) are then overwritten by the border pixel.
    """
    n, planes, height, width = images.shape
    # runs[i] is the `width` bytes starting at byte i of all images: overlapping views, no copy.
    runs = images.as_strided((images.numel() - width + 1, width), (1, 1))
    # Runs of the first and last image may reach beyond the memory: clamp here, and shift these by index below.
    inner = chosen.clamp(1, n - 2)
    dy, dx = offset.unbind(1)
    line = (dy[:, None] + torch.arange(height)).clamp_(0, height - 1)
    start = (inner[:, None] * planes * height + line) * width + dx[:, None]
    start = start[:, None] + torch.arange(planes)[:, None] * (height * width)
    torch.index_select(runs, 0, start.flatten(), out=out.view(start.numel(), width))
    _repeat_borders(out.view(len(out), planes * height, width).numpy(), dx.numpy())
    ends = (chosen != inner).nonzero()[:, 0]  # the clamped ones
    out[ends] = shift_by_index(images[chosen[ends]], offset[ends])


def _repeat_borders(images: np.ndarray, shift: np.ndarray) -> None:
    """Overwrite the columns of (M, lines, W) images that an (M,) shift moved in by the nearest image column."""
    width = images.shape[-1]
    # At most 2 * pad distinct shifts of at most pad columns: two short loops, whatever the batch size.
    for size in np.unique(shift[shift != 0]).tolist():
        moved = np.flatnonzero(shift == size)
        edge = width - 1 - size if size > 0 else -size
        border = images[moved, :, edge]
        for column in range(edge + 1, width) if size > 0 else range(edge):
            images[moved, :, column] = border
