"""A maze's dataset for training: windows of images with the true states of their rows.

Exogenous noise may be added to the images; the small presets use a quarter of the pixels, in grey.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.envs.mazes import MAZES, PICTURE_SIZE, MazeSpec
from vd4rl_pomdp.studies.navigation.config import NavigationConfig, NoiseOptions
from vd4rl_pomdp.studies.navigation.pictures import SHAPES, ExogenousNoise, Picture, to_grey50, to_rgb50

_BLOCK = 1000
HELD_OUT = 10
"""One in this many trajectories, the last ones, is held out."""


def open_maze_set(path: Path, cache: Path | None = None) -> tuple[Dataset, MazeSpec]:
    """A maze's dataset and its maze; UserError for other datasets or without true states."""
    dataset = open_dataset(path, cache)
    attributes = dataset.store.meta["attributes"]
    names = {stored.get("task") for stored in attributes}
    for wrong, what in (
        (len(names) != 1 or not names <= set(MAZES), "names no maze"),
        (dataset.frame_size != PICTURE_SIZE, f"has frames of {dataset.frame_size} pixels, mazes of {PICTURE_SIZE}"),
        (dataset.physics is None, "holds no true states ('physics'), which the probe needs"),
    ):
        if wrong:
            raise UserError(f"{path}: {what}; collect a set with `vd4rl-pomdp navigation collect`")
    if dataset.num_episodes < 2:
        raise UserError(f"{path}: a single trajectory leaves none to be held out; collect more --trajectories")
    if (rows := dataset.episode_end - dataset.episode_start).min() < 2:
        raise UserError(
            f"{path}: trajectory {int(rows.argmin())} is a single row, without a step; take it out of the set, or "
            "collect the set again"
        )
    return dataset, MAZES[names.pop()]


@dataclass(frozen=True)
class TrueStates:
    """Standardised states of all rows of a dataset."""

    values: Tensor
    """(N, 4) float32."""
    hidden: Tensor
    """(N,) bool: a curtain covers the whole mass."""
    mean: Tensor
    std: Tensor
    """(4,) float32, over the training rows."""

    @classmethod
    def of(cls, dataset: Dataset, maze: MazeSpec, training_rows: int) -> TrueStates:
        """States of a dataset, standardised by its first `training_rows` rows."""
        assert dataset.physics is not None
        raw = torch.from_numpy(dataset.physics[:, maze.position + maze.velocity])
        std, mean = torch.std_mean(raw[:training_rows], dim=0)
        hidden = torch.from_numpy(maze.hidden(dataset.physics))
        return cls(((raw - mean) / std).float(), hidden, mean.float(), std.float())

    def to(self, device: torch.device) -> TrueStates:
        """Copy on a device."""
        return TrueStates(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class MazeView(View):
    """Observations of a maze's dataset: one image per row, with the exogenous noise of its key."""

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
        """The same at 50x50, computed once so that training never touches the large images."""
        channels, size = SHAPES[picture]
        shrink = to_grey50 if channels == 1 else to_rgb50
        small = torch.empty(self.dataset.num_rows, channels, size, size, dtype=torch.uint8)
        for rows in torch.arange(self.dataset.num_rows).split(_BLOCK):
            small[rows] = shrink(self.observe(rows))
        self.dataset.frames = small
        return View(self.dataset, frame_stack=1)


def open_data(config: NavigationConfig) -> MazeData:
    """The config's dataset, with its exogenous noise, on the CPU."""
    noise = None
    if isinstance(config.noise, NoiseOptions):
        noise = ExogenousNoise(config.exogenous, config.noise.exogenous_weight, config.seed)
    return MazeData(*open_maze_set(config.data), config, noise)


class MazeData:
    """Batches of a maze's dataset: the last tenth of the trajectories is held out, the others are for training."""

    def __init__(
        self, dataset: Dataset, maze: MazeSpec, config: NavigationConfig, noise: ExogenousNoise | None
    ) -> None:
        self.dataset, self.maze, self._config = dataset, maze, config
        held_out = max(1, dataset.num_episodes // HELD_OUT)
        self.first_held_out = dataset.num_episodes - held_out
        split = int(dataset.episode_start[self.first_held_out])
        self.states = TrueStates.of(dataset, maze, split)
        rows = dataset.transition_rows
        self.training_actions = dataset.action_after(rows[rows < split])
        """(M, 2) float32."""
        self.total = dataset.num_windows(config.window)
        self.training = int(dataset.windows_per_episode(config.window)[: self.first_held_out].sum())
        """Windows 0..training-1 are for training, the others are held out."""
        self.view: View = MazeView(dataset, noise)
        self.inputs = {"data": dataset.fingerprint} | ({} if noise is None else {"exogenous": noise.fingerprint()})
        """Fingerprints of a run's inputs by name."""

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if isinstance(self.view, MazeView) and self._config.picture != "rgb100":
            self.view = self.view.shrunk(self._config.picture)
        self.dataset.to(device)
        self.states = self.states.to(device)
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as observed by the model."""
        return self.view.windows(number, length or self._config.window)

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spaced over the training or held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))
