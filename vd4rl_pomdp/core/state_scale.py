"""Scale of each coordinate of a training set's simulator states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

LEAST_VARIANCE = 1e-10
"""A coordinate with less variance counts as constant, as in the probes."""


@dataclass(frozen=True)
class StateScale:
    """Mean and standard deviation of every coordinate: poses first, then velocities."""

    mean: Tensor
    """(P,) float64."""
    std: Tensor
    """(P,) float64; 0 for constant coordinates."""
    pose: int
    """Number of pose coordinates."""

    @classmethod
    def fit(cls, states: Tensor, pose: int) -> Self:
        """Scale of (N, P) states, whose first `pose` columns are poses."""
        values = states.double()
        variance = values.var(0, correction=0)
        return cls(values.mean(0), torch.where(variance > LEAST_VARIANCE, variance, 0).sqrt(), pose)

    def noise(self, pose: float, velocity: float) -> Tensor:
        """Std (P,) float64 of Gaussian noise with a mean absolute value of `pose` and `velocity` percent of the std."""
        percent = torch.full_like(self.std, velocity)
        percent[: self.pose] = pose
        return percent / 100 * self.std * math.sqrt(math.pi / 2)
