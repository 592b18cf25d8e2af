"""Sample observations: what a model is shown along a drive through each maze."""

from __future__ import annotations

import numpy as np
import torch

from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation.collect import drive
from vd4rl_pomdp.studies.navigation.exogenous import TEXTURES, ExogenousNoise
from vd4rl_pomdp.studies.navigation.observations import to_grey50

SAMPLES = 6
_FIRST_ROW, _ROW_STEP = 20, 12


def sample_observations() -> dict[str, np.ndarray]:
    """Pictures of every maze, then of one in grey and with exogenous noise: (SAMPLES, 3, H, W) uint8 by name."""
    samples = {maze: _drive(maze) for maze in MAZES}
    pictures = torch.from_numpy(samples["three_curtains"])
    noise = ExogenousNoise(TEXTURES, 0.5, 0)
    samples["three_curtains, grey50"] = to_grey50(pictures).expand(-1, 3, -1, -1).numpy()
    samples[f"three_curtains, exogenous {TEXTURES}"] = noise(pictures, torch.arange(len(pictures))).numpy()
    return samples


def _drive(maze: str) -> np.ndarray:
    """Some pictures of a drive: (SAMPLES, 3, 100, 100) uint8."""
    count = _FIRST_ROW + _ROW_STEP * (SAMPLES - 1) + 1
    return drive(maze, rows=count)["observation"][_FIRST_ROW::_ROW_STEP]
