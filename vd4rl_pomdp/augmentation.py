"""Random shift (Kostrikov et al. 2020, arXiv 2004.13649): pad by repeating the border, crop at a random place.

Shifts are whole pixels, so gathering by index gives exactly what DrQ's interpolation gives.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vd4rl_pomdp.corruptions.keys import draw_integers


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
    n, height, width = obs.shape[0], obs.shape[-2], obs.shape[-1]
    offset = draw_integers(key, 2 * pad + 1, 2) - pad
    y = (offset[:, :1] + torch.arange(height, device=obs.device)).clamp_(0, height - 1)
    x = (offset[:, 1:] + torch.arange(width, device=obs.device)).clamp_(0, width - 1)
    pixel = (y[:, :, None] * width + x[:, None, :]).view(n, 1, height * width)
    images = obs.reshape(n, -1, height * width)
    return images.gather(2, pixel.expand_as(images)).view(obs.shape)
