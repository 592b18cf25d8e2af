"""What a model is shown of a maze: the picture, noise added to it, and for the small presets a grey quarter of it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.experiments.navigation.exogenous import ExogenousNoise
from vd4rl_pomdp.mazes import MAZES, PICTURE_SIZE, MazeSpec

Picture = Literal["rgb100", "grey50"]
SHAPES: dict[Picture, tuple[int, int]] = {"rgb100": (3, PICTURE_SIZE), "grey50": (1, PICTURE_SIZE // 2)}
"""Channels and size of an observation."""
_LUMA = (0.299, 0.587, 0.114)
_BLOCK = 1000


def open_maze_set(path: Path, cache: Path | None = None) -> tuple[Dataset, MazeSpec]:
    """A set of maze data and its maze; raises UserError if it is of something else or holds no true states."""
    dataset = open_dataset(path, cache, PICTURE_SIZE)
    attributes = dataset.store.meta["attributes"]
    names = {stored.get("task") for stored in attributes}
    if len(names) != 1 or not names <= set(MAZES):
        raise UserError(f"{path}: names no maze; collect a set with `vd4rl-pomdp navigation collect`")
    if dataset.physics is None:
        raise UserError(
            f"{path}: holds no true states ('physics'), which the probe needs; collect a set with "
            "`vd4rl-pomdp navigation collect`"
        )
    if dataset.num_episodes < 2:
        raise UserError(f"{path}: holds a single trajectory, so none can be held out; collect more --trajectories")
    return dataset, MAZES[names.pop()]


def to_grey50(pictures: Tensor) -> Tensor:
    """Area averages of the luminance: (N, 3, 100, 100) uint8 -> (N, 1, 50, 50) uint8."""
    corners = [pictures[..., row::2, column::2].short() for row in (0, 1) for column in (0, 1)]
    sums = corners[0] + corners[1] + corners[2] + corners[3]
    weights = torch.tensor(_LUMA, device=pictures.device) / 4
    return torch.einsum("nchw,c->nhw", sums.float(), weights).round_().to(torch.uint8)[:, None]


def observe(pictures: Tensor, key: Tensor, picture: Picture, noise: ExogenousNoise | None) -> Tensor:
    """Observations (N, C, S, S) uint8 of (N, 3, 100, 100) uint8 pictures with (N,) int64 row keys."""
    if noise is not None:
        pictures = noise(pictures, key)
    return to_grey50(pictures) if picture == "grey50" else pictures


def shrink(dataset: Dataset, picture: Picture, noise: ExogenousNoise | None) -> Dataset:
    """Replace a set's pictures by small observations, once for all: training then never touches the large ones."""
    blocks = torch.arange(dataset.num_rows).split(_BLOCK)
    small = torch.empty(dataset.num_rows, *_shape(picture), dtype=torch.uint8)
    for rows in blocks:
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        small[part] = observe(dataset.frames[part], dataset.keys(rows), picture, noise)
    dataset.frames = small
    return dataset


def _shape(picture: Picture) -> tuple[int, int, int]:
    channels, size = SHAPES[picture]
    return channels, size, size
