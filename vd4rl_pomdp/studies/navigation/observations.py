"""What a model is shown of a maze: the picture, noise added to it, and for the small presets a grey quarter of it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.envs.mazes import MAZES, PICTURE_SIZE, MazeSpec
from vd4rl_pomdp.studies.navigation.exogenous import ExogenousNoise

Picture = Literal["rgb100", "rgb50", "grey50"]
_HALF = PICTURE_SIZE // 2
SHAPES: dict[Picture, tuple[int, int]] = {"rgb100": (3, PICTURE_SIZE), "rgb50": (3, _HALF), "grey50": (1, _HALF)}
"""Channels and size of an observation."""
_LUMA = (0.299, 0.587, 0.114)
_BLOCK = 1000


def open_maze_set(path: Path, cache: Path | None = None) -> tuple[Dataset, MazeSpec]:
    """A set of maze data and its maze; raises UserError if it is of something else or holds no true states."""
    dataset = open_dataset(path, cache)
    attributes = dataset.store.meta["attributes"]
    names = {stored.get("task") for stored in attributes}
    if len(names) != 1 or not names <= set(MAZES):
        raise UserError(f"{path}: names no maze; collect a set with `vd4rl-pomdp navigation collect`")
    if dataset.frame_size != PICTURE_SIZE:
        raise UserError(
            f"{path}: has frames of {dataset.frame_size} pixels, mazes of {PICTURE_SIZE}; collect a set with "
            "`vd4rl-pomdp navigation collect`"
        )
    if dataset.physics is None:
        raise UserError(
            f"{path}: holds no true states ('physics'), which the probe needs; collect a set with "
            "`vd4rl-pomdp navigation collect`"
        )
    check_trajectories(dataset.num_episodes, str(path))
    if (rows := dataset.episode_end - dataset.episode_start).min() < 2:
        raise UserError(
            f"{path}: trajectory {int(rows.argmin())} is a single row, without a step; take it out of the set, or "
            "collect the set again"
        )
    return dataset, MAZES[names.pop()]


def check_trajectories(number: int, where: str) -> None:
    """Raise UserError for a set of so few trajectories that none can be held out."""
    if number < 2:
        raise UserError(f"{where}: a single trajectory leaves none to be held out; collect more --trajectories")


def to_grey50(pictures: Tensor) -> Tensor:
    """Area averages of the luminance: (N, 3, 100, 100) uint8 -> (N, 1, 50, 50) uint8."""
    weights = torch.tensor(_LUMA, device=pictures.device) / 4
    return torch.einsum("nchw,c->nhw", _sums(pictures).float(), weights).round_().to(torch.uint8)[:, None]


def to_rgb50(pictures: Tensor) -> Tensor:
    """Area averages: (N, 3, 100, 100) uint8 -> (N, 3, 50, 50) uint8."""
    return ((_sums(pictures) + 2) // 4).to(torch.uint8)


def _sums(pictures: Tensor) -> Tensor:
    """Sums over 2x2 pixels, int16."""
    corners = [pictures[..., row::2, column::2].short() for row in (0, 1) for column in (0, 1)]
    return corners[0] + corners[1] + corners[2] + corners[3]


class MazeView(View):
    """A maze's set as a model sees it: one picture a row, with the exogenous noise of its key."""

    def __init__(self, dataset: Dataset, noise: ExogenousNoise | None) -> None:
        super().__init__(dataset, frame_stack=1)
        self._noise = noise

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """Observations (N, ..., 3, 100, 100) uint8 of (N, ...) int64 rows."""
        pictures = super().observe(rows, shift_key)
        if self._noise is None:
            return pictures
        noisy = self._noise(pictures.flatten(0, -4), self.dataset.keys(rows).flatten())
        return noisy.view(pictures.shape)

    def shrunk(self, picture: Picture) -> View:
        """The same at 50x50, drawn once for all: training then never touches the large pictures."""
        channels, size = SHAPES[picture]
        shrink = to_grey50 if channels == 1 else to_rgb50
        small = torch.empty(self.dataset.num_rows, channels, size, size, dtype=torch.uint8)
        for rows in torch.arange(self.dataset.num_rows).split(_BLOCK):
            small[rows] = shrink(self.observe(rows))
        self.dataset.frames = small
        return View(self.dataset, frame_stack=1)
