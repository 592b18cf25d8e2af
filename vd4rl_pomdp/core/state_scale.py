"""How far each coordinate of a training set's simulator states varies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

LEAST_VARIANCE = 1e-10
"""A coordinate that varies less counts as constant, as for the probes."""


@dataclass(frozen=True)
class StateScale:
    """Mean and standard deviation of every coordinate, poses first, velocities behind them."""

    mean: Tensor
    """(P,) float64."""
    std: Tensor
    """(P,) float64; 0 for coordinates that are constant."""
    pose: int
    """Coordinates that are pose."""

    @classmethod
    def fit(cls, states: Tensor, pose: int) -> Self:
        """The scale of (N, P) states, the first `pose` columns of which are poses."""
        values = states.double()
        variance = values.var(0, correction=0)
        return cls(values.mean(0), torch.where(variance > LEAST_VARIANCE, variance, 0).sqrt(), pose)

    def noise(self, pose: float, velocity: float) -> Tensor:
        """Standard deviations (P,) float64 of normal noise whose mean absolute value is a share of each coordinate's.

        Args:
            pose: percent of a pose's standard deviation.
            velocity: percent of a velocity's.
        """
        percent = torch.full_like(self.std, velocity)
        percent[: self.pose] = pose
        return percent / 100 * self.std * math.sqrt(math.pi / 2)
