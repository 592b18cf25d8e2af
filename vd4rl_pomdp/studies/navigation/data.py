"""A maze's set as the model sees it: windows of observations with the true states of their rows."""

from __future__ import annotations

import torch
from torch import Tensor

from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.data import Dataset, View
from vd4rl_pomdp.envs.mazes import MazeSpec
from vd4rl_pomdp.studies.navigation.config import NavigationConfig, NoiseOptions
from vd4rl_pomdp.studies.navigation.exogenous import ExogenousNoise
from vd4rl_pomdp.studies.navigation.observations import MazeView, open_maze_set
from vd4rl_pomdp.studies.navigation.probe import TrueStates

HELD_OUT = 10
"""One in this many trajectories, the last ones, is never trained on."""


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
        self._view: View = MazeView(dataset, noise)
        self.inputs = {"data": dataset.fingerprint} | ({} if noise is None else {"exogenous": noise.fingerprint()})
        """What a run on it reads, by name and content."""

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if isinstance(self._view, MazeView) and self._config.picture != "rgb100":
            self._view = self._view.shrunk(self._config.picture)
        self.dataset.to(device)
        self.states = self.states.to(device)
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as the model sees them."""
        return self._view.windows(number, length or self._config.window)

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spread over the training or the held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))
