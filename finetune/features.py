"""Frozen means cacheable: encode the set once under several draws of corruption and shift, train on the features."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.augmentation import observe
from vd4rl_pomdp.corruptions import BatchCorruption, CorruptionConfig, KeyStream, derive_keys
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.runs.device import Precision, autocast
from vd4rl_pomdp.runs.folder import replacing_file
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.reading import regular
from vd4rl_pomdp.types import Batch

CHUNK = 128
"""Rows that go through the frame encoder at once."""
SHIFT_STREAM, BATCH_STREAM = 3, 4
"""Numbers that keep a run's seeded streams apart; view v corrupts with stream (seed, v)."""


@dataclass(frozen=True)
class FeatureBatch(Batch):
    """n-step transitions of representations (see `Transitions` for reward and discount)."""

    z: Tensor
    """(B, D)."""
    action: Tensor
    """(B, A)."""
    reward: Tensor
    """(B,)."""
    discount: Tensor
    """(B,)."""
    next_z: Tensor
    """(B, D)."""


class FrozenEncoder:
    """A frozen encoder with the corruption and shift under which it sees a data set."""

    def __init__(
        self,
        encoder: Encoder,
        dataset: Dataset,
        corruption: CorruptionConfig,
        shift: int,
        precision: Precision,
        seed: int,
    ) -> None:
        self.encoder, self.dataset, self.shift, self.precision, self.seed = encoder, dataset, shift, precision, seed
        self.device = dataset.t.device
        self._corruption_config = corruption
        self.states = dataset.states() if encoder.reads_state else torch.empty(0)

    def corruption(self, view: int) -> BatchCorruption:
        """The corruption of a view; under `emission` all views look the same."""
        emission = self._corruption_config.corruption_mode == "emission"
        return BatchCorruption(self._corruption_config, self.seed if emission else self.seed * 1000 + view)

    @torch.no_grad()
    def rows(self, rows: Tensor, shift_key: Tensor, corruption: BatchCorruption) -> Tensor:
        """Frame features (N, F) of (N,) rows, shifted by (N,) keys, in chunks."""
        if self.encoder.reads_state:
            return self.encoder.frame(self.states[rows, :, None, None])
        parts = []
        for part, key in zip(rows.split(CHUNK), shift_key.split(CHUNK), strict=True):
            obs = observe(self.dataset, part, key, self.shift, corruption)
            with autocast(self.device, self.precision):
                parts.append(self.encoder.frame(obs).float())
        return torch.cat(parts)

    @torch.no_grad()
    def episode(self, number: int, view: int, corruption: BatchCorruption) -> Tensor:
        """Representations (rows, D) of a whole episode, streamed from its first row."""
        start, end = int(self.dataset.episode_start[number]), int(self.dataset.episode_end[number])
        rows = torch.arange(start, end, device=self.device)
        key = derive_keys(self.seed * 10 + SHIFT_STREAM, torch.tensor([view << 32 | number], device=self.device))
        features = self.rows(rows, key.expand(len(rows)), corruption)
        prev_action = self.dataset.action[rows].clone()
        prev_action[0] = 0
        return self.encoder.from_features(features[None], prev_action[None])[0]


def encode_views(frozen: FrozenEncoder, views: int, path: Path) -> Tensor:
    """Encode the whole set under `views` draws, or read what was encoded before.

    Returns:
        (views, N, D) float16 on the data set's device; `path` keeps them for the run's resumption.
    """
    dataset = frozen.dataset
    if not path.exists():
        out = np.empty((views, dataset.num_rows, frozen.encoder.dim), np.float16)
        with ProgressLine("encode", views * dataset.num_episodes, "episodes") as progress:
            for view in range(views):
                corruption = frozen.corruption(view)
                for number in range(dataset.num_episodes):
                    start, end = int(dataset.episode_start[number]), int(dataset.episode_end[number])
                    out[view, start:end] = frozen.episode(number, view, corruption).cpu().numpy()
                    progress.advance()
        with replacing_file(path) as fresh, fresh.open("wb") as file:
            np.save(file, out)
    return torch.from_numpy(_read_views(path, (views, dataset.num_rows, frozen.encoder.dim))).to(dataset.t.device)


def _read_views(path: Path, shape: tuple[int, int, int]) -> np.ndarray:
    """Features as `encode_views` wrote them, or UserError."""
    try:
        views = np.load(regular(path))
    except UserError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read ({error}); remove it, and the set is encoded anew") from error
    if views.shape != shape or views.dtype != np.float16 or not all(np.isfinite(view).all() for view in views):
        raise UserError(f"{path}: is not what this run encoded; remove it, and the set is encoded anew")
    return views


class FeatureSampler:
    """Uniform n-step transitions of cached features; a transition's two ends come from the same view."""

    def __init__(
        self, dataset: Dataset, features: Tensor, batch_size: int, n_step: int, gamma: float, generator: torch.Generator
    ) -> None:
        self._features, self._batch_size, self._generator = features, batch_size, generator
        starts = torch.nonzero(dataset.t[1:] > 0)[:, 0]
        self._rows = starts
        self._reward, self._discount, self._next = dataset.n_step_returns(starts, n_step, gamma)
        self._action = dataset.action[starts + 1]

    def sample(self) -> FeatureBatch:
        """The next batch."""
        device = self._rows.device
        index = torch.randint(len(self._rows), (self._batch_size,), generator=self._generator).to(device)
        view = torch.randint(len(self._features), (self._batch_size,), generator=self._generator).to(device)
        return FeatureBatch(
            z=self._features[view, self._rows[index]].float(),
            action=self._action[index],
            reward=self._reward[index],
            discount=self._discount[index],
            next_z=self._features[view, self._next[index]].float(),
        )


class ExactSampler:
    """Uniform n-step transitions whose representations are computed anew for every batch, from whole histories."""

    def __init__(
        self, frozen: FrozenEncoder, batch_size: int, n_step: int, gamma: float, generator: torch.Generator
    ) -> None:
        self._frozen, self._batch_size, self._n_step, self._gamma = frozen, batch_size, n_step, gamma
        self._generator = generator
        self.corruption = frozen.corruption(0)
        self.shifts = KeyStream(frozen.seed * 10 + SHIFT_STREAM)
        self._starts = torch.nonzero(frozen.dataset.t[1:] > 0)[:, 0]

    def sample(self) -> FeatureBatch:
        """The next batch; sequence encoders read every row from the episode's start, or their history window."""
        dataset = self._frozen.dataset
        index = torch.randint(len(self._starts), (self._batch_size,), generator=self._generator)
        rows = self._starts[index.to(self._starts.device)]
        reward, discount, next_rows = dataset.n_step_returns(rows, self._n_step, self._gamma)
        z, next_z = self._encode(rows, next_rows)
        return FeatureBatch(z, dataset.action[rows + 1], reward, discount, next_z)

    @torch.no_grad()
    def _encode(self, rows: Tensor, next_rows: Tensor) -> tuple[Tensor, Tensor]:
        dataset, encoder = self._frozen.dataset, self._frozen.encoder
        key = self.shifts.take((len(rows),), rows.device)
        if encoder.gru is None:
            features = self._frozen.rows(torch.cat([rows, next_rows]), key.repeat(2), self.corruption)
            return features[: len(rows)], features[len(rows) :]
        first = dataset.episode_start[dataset.episode[rows]]
        if encoder.config.history_window:
            first = torch.maximum(first, rows - encoder.config.history_window + 1)
        span = torch.arange(int((next_rows - first).max()) + 1, device=rows.device)
        history = torch.minimum(first[:, None] + span, next_rows[:, None])
        features = self._frozen.rows(history.reshape(-1), key.repeat_interleave(len(span)), self.corruption)
        prev_action = dataset.action[history].clone()
        prev_action[:, 0] = 0
        states = encoder.from_features(features.view(*history.shape, -1), prev_action)
        pick = torch.arange(len(rows), device=rows.device)
        return states[pick, rows - first], states[pick, next_rows - first]
