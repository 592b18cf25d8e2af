"""A maze's dataset for training: windows of images with the true states of their rows.

Exogenous noise may be added to the images; the small presets use a quarter of the pixels, in grey.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.envs.mazes import MAZES, PICTURE_SIZE
from vd4rl_pomdp.studies.navigation.config import NavigationConfig, NoiseOptions
from vd4rl_pomdp.studies.navigation.pictures import SHAPES, ExogenousNoise, source_fingerprint, to_grey50, to_rgb50

_BLOCK = 1000
HELD_OUT = 10
"""One in this many trajectories, the last ones, is held out."""


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


class MazeData:
    """Batches of a maze's dataset: the last tenth of the trajectories is held out, the others are for training."""

    def __init__(self, config: NavigationConfig, cache: Path | None = None) -> None:
        """Open the config's dataset, with its exogenous noise, on the CPU; UserError if it does not fit."""
        dataset, path = open_dataset(config.data, cache), config.data
        names = {stored.get("task") for stored in dataset.store.meta["attributes"]}
        for wrong, what in (
            (len(names) != 1 or not names <= set(MAZES), "names no maze"),
            (dataset.frame_size != PICTURE_SIZE, f"has frames of {dataset.frame_size} pixels, mazes of {PICTURE_SIZE}"),
            (dataset.physics is None, "holds no true states ('physics'), which the probe needs"),
        ):
            if wrong:
                raise UserError(f"{path}: {what}; collect a dataset with `vd4rl-pomdp navigation collect`")
        if dataset.num_episodes < 2:
            raise UserError(f"{path}: a single trajectory leaves none to hold out; collect more --trajectories")
        if (lengths := dataset.episode_end - dataset.episode_start).min() < 2:
            raise UserError(
                f"{path}: trajectory {int(lengths.argmin())} is a single row, without a step; remove it, "
                "or collect the dataset again"
            )
        self.dataset, self.maze, self._config = dataset, MAZES[names.pop()], config
        self.first_held_out = dataset.num_episodes - max(1, dataset.num_episodes // HELD_OUT)
        split = int(dataset.episode_start[self.first_held_out])
        assert dataset.physics is not None
        raw = torch.from_numpy(dataset.physics[:, self.maze.position + self.maze.velocity])
        std, mean = torch.std_mean(raw[:split], dim=0)
        self.states, self.mean, self.std = ((raw - mean) / std).float(), mean.float(), std.float()
        """(N, 4) float32 states of all rows, standardised by mean and std (4,) of the training rows."""
        self.hidden = torch.from_numpy(self.maze.hidden(dataset.physics))
        """(N,) bool: a curtain covers the whole mass."""
        rows = dataset.transition_rows
        self.training_actions = dataset.action_after(rows[rows < split])
        """(M, 2) float32."""
        self.total = dataset.num_windows(config.window)
        self.training = int(dataset.windows_per_episode(config.window)[: self.first_held_out].sum())
        """Windows 0..training-1 are for training, the others are held out."""
        self.inputs = {"data": dataset.fingerprint}
        """Fingerprints of a run's inputs by name."""
        noise = None
        if isinstance(config.noise, NoiseOptions):
            noise = ExogenousNoise(config.exogenous, config.noise.exogenous_weight, config.seed)
            self.inputs["exogenous"] = source_fingerprint(config.exogenous)
        self.view: View = MazeView(dataset, noise)

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if self._config.picture != "rgb100":  # shrunk once, so that training never touches the large images
            channels, size = SHAPES[self._config.picture]
            shrink = to_grey50 if channels == 1 else to_rgb50
            small = torch.empty(self.dataset.num_rows, channels, size, size, dtype=torch.uint8)
            for rows in torch.arange(self.dataset.num_rows).split(_BLOCK):
                small[rows] = shrink(self.view.observe(rows))
            self.dataset.frames, self.view = small, View(self.dataset, frame_stack=1)
        self.dataset.to(device)
        for name in ("states", "hidden", "mean", "std"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as observed by the model."""
        return self.view.windows(number, length or self._config.window)

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spaced over the training or held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))
