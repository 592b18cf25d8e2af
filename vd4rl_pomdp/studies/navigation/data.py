"""A maze's set as a model sees it: windows of pictures with the true states of their rows.

Exogenous noise may be added to the pictures; the small presets see a quarter of their pixels, in grey.
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
"""One in this many trajectories, the last ones, is never trained on."""


def open_maze_set(path: Path, cache: Path | None = None) -> tuple[Dataset, MazeSpec]:
    """A set of maze data and its maze; raises UserError if it is of something else or holds no true states."""
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
    """Standardised states of all rows of a set."""

    values: Tensor
    """(N, 4) float32."""
    hidden: Tensor
    """(N,) bool: a curtain covers the whole mass."""
    mean: Tensor
    std: Tensor
    """(4,) float32, of the training rows."""

    @classmethod
    def of(cls, dataset: Dataset, maze: MazeSpec, training_rows: int) -> TrueStates:
        """States of a set, standardised by its first `training_rows` rows."""
        assert dataset.physics is not None
        raw = torch.from_numpy(dataset.physics[:, maze.position + maze.velocity])
        std, mean = torch.std_mean(raw[:training_rows], dim=0)
        hidden = torch.from_numpy(maze.hidden(dataset.physics))
        return cls(((raw - mean) / std).float(), hidden, mean.float(), std.float())

    def to(self, device: torch.device) -> TrueStates:
        """Copy on a device."""
        return TrueStates(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


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


def open_data(config: NavigationConfig) -> MazeData:
    """The set that a config names, with its exogenous noise, on the CPU."""
    noise = None
    if isinstance(config.noise, NoiseOptions):
        noise = ExogenousNoise(config.exogenous, config.noise.exogenous_weight, config.seed)
    return MazeData(*open_maze_set(config.data), config, noise)


class MazeData:
    """Batches of a maze's set: the first trajectories are for training, the last tenth is held out."""

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
        """Windows 0..training-1 are for training, the rest is held out."""
        self.view: View = MazeView(dataset, noise)
        self.inputs = {"data": dataset.fingerprint} | ({} if noise is None else {"exogenous": noise.fingerprint()})
        """What a run on it reads, by name and content."""

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if isinstance(self.view, MazeView) and self._config.picture != "rgb100":
            self.view = self.view.shrunk(self._config.picture)
        self.dataset.to(device)
        self.states = self.states.to(device)
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as the model sees them."""
        return self.view.windows(number, length or self._config.window)

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spread over the training or the held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))
