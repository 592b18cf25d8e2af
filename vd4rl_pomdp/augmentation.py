"""What an agent sees of a data set's rows: random shift, then corruption.

Random shift (Kostrikov et al. 2020, arXiv 2004.13649): pad by repeating the border, crop at a random place. Shifts are
whole pixels, so gathering by index gives exactly what DrQ's interpolation gives.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.buffers import FrameBuffers
from vd4rl_pomdp.corruptions import BatchCorruption, draw_integers
from vd4rl_pomdp.data.dataset import Dataset
from vd4rl_pomdp.tasks import FRAME_STACK

_BUFFERS = FrameBuffers()


def observe(dataset: Dataset, rows: Tensor, shift_key: Tensor, pad: int, corruption: BatchCorruption) -> Tensor:
    """Frame stacks of rows, shifted, then corrupted. On a CPU, frames that the corruption zeroes are never read.

    Args:
        dataset: the set.
        rows: (N, ...) int64.
        shift_key: (N,) int64; everything under one leading index moves together.
        pad: largest shift in pixels.
        corruption: what makes the observations partial.

    Returns:
        (N, ..., C, H, W) uint8.
    """
    if not _by_lines(dataset.frames, pad):
        return corruption(random_shift(dataset.stacks(rows), shift_key, pad), dataset.keys(rows))
    keys = corruption.keys(dataset.keys(rows)).flatten()
    kept = corruption.corruption.kept(keys, FRAME_STACK)
    chosen = dataset.stack_rows(rows).view(-1, FRAME_STACK).gather(1, kept)
    images = _BUFFERS.take((chosen.numel() + 1, *dataset.frames.shape[1:]))
    offset = _draw_offset(shift_key, pad).repeat_interleave(chosen.numel() // len(shift_key), 0)
    _shift_by_lines(dataset.frames, chosen.flatten(), offset, images[:-1])
    corruption.corruption.change_(images[:-1].view(*chosen.shape, *images.shape[1:]), keys, kept)
    obs = images[:-1] if kept.shape[1] == FRAME_STACK else _spread(images, kept)
    return obs.view(*rows.shape, -1, *images.shape[2:])


def _spread(images: Tensor, kept: Tensor) -> Tensor:
    """Put frames at their (N, K) places in stacks of zeros; `images` has room for one of zeros behind them."""
    images[-1] = 0
    source = torch.full((len(kept), FRAME_STACK), kept.numel())
    source.scatter_(1, kept, torch.arange(kept.numel()).view(kept.shape))
    out = _BUFFERS.take((source.numel(), *images.shape[1:]))
    return torch.index_select(images, 0, source.flatten(), out=out)


def random_shift(obs: Tensor, key: Tensor, pad: int = 4) -> Tensor:
    """Shift images by up to `pad` pixels in each direction.

    Args:
        obs: (N, ..., H, W) uint8; everything under one leading index moves together.
        key: (N,) int64, one shift a key.
        pad: largest shift in pixels; 0 returns `obs`.

    Returns:
        Tensor like `obs`.
    """
    if pad == 0:
        return obs
    offset = _draw_offset(key, pad)
    if not _by_lines(obs, pad):
        return _shift_by_index(obs, offset)
    out = _BUFFERS.take(obs.shape)
    images, shifted = (x.view(len(obs), -1, *obs.shape[-2:]) for x in (obs, out))
    _shift_by_lines(images, torch.arange(len(obs)), offset, shifted)
    return out


def _draw_offset(key: Tensor, pad: int) -> Tensor:
    return draw_integers(key, 2 * pad + 1, 2) - pad


def _by_lines(images: Tensor, pad: int) -> bool:
    sizes = len(images) > 2 and 0 < pad < min(images.shape[-2:])
    return sizes and images.device.type == "cpu" and images.is_contiguous()


def _shift_by_index(obs: Tensor, offset: Tensor) -> Tensor:
    """One gather of single pixels: right for a GPU, slow on a CPU."""
    n, height, width = obs.shape[0], obs.shape[-2], obs.shape[-1]
    y = (offset[:, :1] + torch.arange(height, device=obs.device)).clamp_(0, height - 1)
    x = (offset[:, 1:] + torch.arange(width, device=obs.device)).clamp_(0, width - 1)
    pixel = (y[:, :, None] * width + x[:, None, :]).view(n, 1, height * width)
    images = obs.reshape(n, math.prod(obs.shape[1:-2]), height * width)
    return images.gather(2, pixel.expand_as(images)).view(obs.shape)


def _shift_by_lines(images: Tensor, chosen: Tensor, offset: Tensor, out: Tensor) -> None:
    """The same for the (M,) `chosen` ones of (N > 2, planes, H, W) images, many times as fast on a CPU.

    A shifted line is a run of bytes in memory that begins dx further on; only what the run holds of the line beside it
    must then be overwritten by the border.
    """
    n, planes, height, width = images.shape
    runs = images.as_strided((images.numel() - width + 1, width), (1, 1))
    inner = chosen.clamp(1, n - 2)
    dy, dx = offset.unbind(1)
    line = (dy[:, None] + torch.arange(height)).clamp_(0, height - 1)
    start = (inner[:, None] * planes * height + line) * width + dx[:, None]
    start = start[:, None] + torch.arange(planes)[:, None] * (height * width)
    torch.index_select(runs, 0, start.flatten(), out=out.view(start.numel(), width))
    _repeat_borders(out.view(len(out), planes * height, width).numpy(), dx.numpy())
    ends = (chosen != inner).nonzero()[:, 0]  # whose runs may reach beyond the images' memory
    out[ends] = _shift_by_index(images[chosen[ends]], offset[ends])


def _repeat_borders(images: np.ndarray, shift: np.ndarray) -> None:
    """Overwrite the columns of (M, lines, W) images that an (M,) shift brought in by the outermost true one."""
    width = images.shape[-1]
    for size in np.unique(shift[shift != 0]).tolist():
        moved = np.flatnonzero(shift == size)
        edge = width - 1 - size if size > 0 else -size
        border = images[moved, :, edge]
        for column in range(edge + 1, width) if size > 0 else range(edge):
            images[moved, :, column] = border
