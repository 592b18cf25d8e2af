"""Random shift (Kostrikov et al. 2020, arXiv 2004.13649): pad by repeating the border, crop at a random place."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from vd4rl_pomdp.core.buffers import BUFFERS
from vd4rl_pomdp.corruptions import _shift

Sharing = Literal["window", "observation"]
"""What of a batch of windows one random shift is shared by: all observations of a window, or the frames of one."""


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
    offset = _shift.draw_offset(key, pad)
    if not _shift.by_lines(obs, pad):
        return _shift.shift_by_index(obs, offset)
    out = BUFFERS.take(obs.shape)
    images, shifted = (x.view(len(obs), -1, *obs.shape[-2:]) for x in (obs, out))
    _shift.shift_by_lines(images, torch.arange(len(obs)), offset, shifted)
    return out
