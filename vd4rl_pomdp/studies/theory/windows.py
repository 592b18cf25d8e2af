"""Exact sequences of a finite world as the batches that learned objectives train on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.types import Windows, previous, row_key
from vd4rl_pomdp.studies.theory.law import Law, joint_law
from vd4rl_pomdp.studies.theory.world import World


@dataclass(frozen=True)
class ExactWindows:
    """Every sequence of `rows` rows that a world can produce, once each, and how likely it is."""

    windows: Windows
    """obs (N, T, C, 1, 1) uint8, one channel a symbol, 0 or 255; actions (N, T, A) float32, one-hot."""
    probability: Tensor
    """(N,) float64."""
    state: Tensor
    """(N, T) int64: place of s_j in the world's states."""

    def draw(self, count: int, generator: torch.Generator) -> Windows:
        """A batch of `count` windows drawn by their probability."""
        fields = self.windows.keys()
        index = torch.multinomial(self.probability, count, replacement=True, generator=generator)
        return self.windows.replace(**{name: self.windows[name][index] for name in fields})


def one_hot(index: np.ndarray, count: int) -> np.ndarray:
    """(...) places to (..., count) float32."""
    return np.eye(count, dtype=np.float32)[index]


def exact_windows(world: World, rows: int) -> ExactWindows:
    """All sequences of a world that begin in its initial law; windows end inside their episode, as in training."""
    law = joint_law(world, [(kind, j) for kind in ("s", "o", "a") for j in range(rows)])
    obs = one_hot(_codes(law, "o", rows), len(world.symbols))
    action = torch.from_numpy(one_hot(_codes(law, "a", rows), len(world.actions)))
    count = len(law.counts)
    windows = Windows(
        obs=torch.from_numpy((obs * 255).astype(np.uint8))[..., None, None],
        prev_action=previous(action),
        action=action,
        has_action=torch.ones(count, rows, dtype=torch.bool),
        length=torch.full((count,), rows),
        key=row_key(torch.arange(count)[:, None], torch.arange(rows)),
    )
    weights = law.counts.astype(object)
    probability = torch.tensor([float(p) for p in weights / sum(weights)], dtype=torch.float64)
    return ExactWindows(windows, probability, torch.from_numpy(_codes(law, "s", rows)))


def _codes(law: Law, kind: str, rows: int) -> np.ndarray:
    """(N, rows) int64 codes of one kind of variable."""
    return np.stack([law.column((kind, j)) for j in range(rows)], axis=1)
