"""Cache the frozen encoder's features: encode the dataset once under several draws of corruption and shift.

With `--views 0` every batch is encoded on the fly instead.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from torch import Tensor

from finetune.histories import Histories, HistoryOptions, read_both_ends, read_whole
from vd4rl_pomdp.core.errors import disk_errors
from vd4rl_pomdp.core.hardware import Precision, autocast
from vd4rl_pomdp.core.options import Options, flat
from vd4rl_pomdp.core.streams import RandomStream, stacked
from vd4rl_pomdp.core.types import Batch
from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys
from vd4rl_pomdp.data import Dataset, StateView, View
from vd4rl_pomdp.data.view import Sampler
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.frame import StateFrame
from vd4rl_pomdp.runs.files import content_hash, replacing_file
from vd4rl_pomdp.runs.progress import ProgressLine

CHUNK, GPU_CHUNK = 128, 1024
"""Batch size of the frame encoder, in rows, on a CPU and on a GPU."""
GPU_GROUP = 4096
"""Rows of consecutive episodes that a memory processes at once on a GPU; on a CPU it processes one episode at a
time."""
STAGE = "finetune"


@dataclass(frozen=True)
class FeatureBatch(Batch):
    """n-step transitions of representations (see `Transitions` for reward and discount)."""

    z: Tensor  # (B, D)
    action: Tensor  # (B, A)
    reward: Tensor  # (B,)
    discount: Tensor  # (B,)
    next_z: Tensor  # (B, D)
    next_action: Tensor  # (B, A), the dataset's action at next_z; zero at an episode's last row, which has none


class FrozenEncoder:
    """A frozen encoder, with the corruption and shift under which it sees a dataset."""

    def __init__(
        self,
        encoder: Encoder,
        dataset: Dataset,
        corruption: CorruptionConfig,
        shift: int,
        precision: Precision,
        seed: int,
    ) -> None:
        self.encoder, self.dataset, self.precision = encoder, dataset, precision
        self._shift, self._seed = shift, seed
        self.device = dataset.t.device
        self._corruption = corruption
        # CPU results depend on the batch size in their last digits, so keep the original one there
        self.chunk, self.group = (CHUNK, 1) if self.device.type == "cpu" else (GPU_CHUNK, GPU_GROUP)

    def view(self, number: int) -> View:
        """One draw of corruption and shift. `emission` corruptions are the same in every view."""
        # seeded by the run, so the spread over seeds includes that of the corruption
        if isinstance(self.encoder.frame, StateFrame):
            return StateView(self.dataset, self.encoder.frame.observe, self._corruption, self._seed, STAGE, number)
        return View(self.dataset, self._corruption, self._shift, self._seed, STAGE, number)

    @torch.no_grad()
    def rows(self, rows: Tensor, shift_key: Tensor, view: View) -> Tensor:
        """Frame features (N, F) of (N,) rows, shifted by (N,) keys, in chunks."""
        parts = []
        for part, key in zip(rows.split(self.chunk), shift_key.split(self.chunk), strict=True):
            obs = view.observe(part, key)
            with autocast(self.device, self.precision):
                parts.append(self.encoder.frame(obs).float())
        return torch.cat(parts)

    @torch.no_grad()
    def episode(self, number: int, view: View) -> Tensor:
        """Representations (rows, D) of a whole episode, streamed from its first row."""
        one = range(number, number + 1)
        return read_whole(self.encoder, self.frames(one, view), self.dataset, one)

    def frames(self, episodes: range, view: View) -> Tensor:
        """Frame features (rows, F) of consecutive whole episodes, with one shift per episode."""
        whole = self.dataset.rows_of(episodes)
        rows = torch.arange(whole.start, whole.stop, device=self.device)
        # a memory would mistake shifts that change within an episode for motion
        return self.rows(rows, derive_keys(view.shifts.seed, self.dataset.episode[rows]), view)

    def groups(self) -> Iterator[range]:
        """All episodes in order, grouped so that each group padded to its longest episode has at most `group` rows."""
        lengths = (self.dataset.episode_end - self.dataset.episode_start).tolist()
        first, longest = 0, 0
        for number, length in enumerate(lengths):
            longest = max(longest, length)
            if number > first and longest * (number + 1 - first) > self.group:
                yield range(first, number)
                first, longest = number, length
        yield range(first, len(lengths))

    def name(self, encoder: str) -> str:
        """Cache key of all features of the dataset under this encoder: equal for equal features."""
        network = [encoder, asdict(self.encoder.config), self.precision]
        drawn = [self.dataset.fingerprint, flat(self._corruption), self._shift, self._seed]
        return content_hash([network, drawn, str(self.device), self.chunk, self.group])


_ENCODED: WeakValueDictionary[tuple[str, str, int], Tensor] = WeakValueDictionary()
"""Features still in use by a training in this process, by everything that determines them."""
_SAVED: dict[tuple[str, str, int], Path] = {}
"""The last file of each."""


def encode_views(frozen: FrozenEncoder, histories: Histories, views: int, cached: Path, encoder: str) -> Tensor:
    """Encode the whole dataset under `views` draws, or reuse the features from this process or from this run's file.

    Args:
        frozen: the encoder and its dataset.
        histories: which features there are.
        views: number of draws of corruption and shift.
        cached: file of the features for resuming; the run itself checks that dataset and encoder are unchanged.
        encoder: hash of the encoder's weights (`encoder_hash`).

    Returns:
        (views, features, D) on the dataset's device; numbered as in `Histories`. float16 for pixels; float32 for
        simulator states, which may differ very little before they are scaled up. Read-only: trainings on the same
        features share them.
    """
    key = frozen.name(encoder), histories.name(), views
    if (features := _ENCODED.get(key)) is None:
        if cached.exists():
            with disk_errors(cached):
                features = torch.from_numpy(np.load(cached)).to(frozen.device)
        else:
            dtype = torch.float32 if frozen.encoder.reads_state else torch.float16
            features = torch.empty((views, histories.features, frozen.encoder.dim), dtype=dtype, device=frozen.device)
            total = views * frozen.dataset.num_episodes
            # on a GPU, no_grad avoids compiling, which takes longer than the encoding
            with torch.no_grad(), ProgressLine("encode", total, "episodes") as progress:
                for number in range(views):
                    view, random = frozen.view(number), histories.of_view(number)
                    for episodes in frozen.groups():
                        random.fill(features[number], frozen.encoder, frozen.frames(episodes, view), episodes)
                        progress.advance(len(episodes))
        _ENCODED[key] = features
    if not cached.exists():  # also where trainings share features: each resumes by itself
        try:
            os.link(_SAVED[key], cached)
        except (KeyError, OSError):
            with replacing_file(cached) as fresh, fresh.open("wb") as file:
                np.save(file, features.cpu().numpy())
    _SAVED[key] = cached
    return features


class FeatureSampler:
    """Uniform n-step transitions of cached features. Both ends of a transition come from the same view."""

    def __init__(
        self, histories: Histories, features: Tensor, batch_size: int, n_step: int, gamma: float,
        draws: RandomStream,
    ) -> None:  # fmt: skip
        self.features, self.batch_size, self.draws = features, batch_size, draws
        dataset, rows = histories.dataset, histories.rows
        reward, discount, _ = dataset.n_step_returns(rows, n_step, gamma)
        actions = dataset.action_after(rows), dataset.action_or_zero(histories.ends)
        self.data = torch.cat([*actions, reward[:, None], discount[:, None]], dim=1)
        """(M, 2 A + 2): actions at both ends, reward and discount of every transition, in one tensor to save GPU kernel
        launches."""
        # the critics' targets can use cached z' because the encoder never changes
        ends = [torch.stack(histories.of_view(view).numbers()) for view in range(len(features))]
        self.ends = torch.stack([number + view * features.shape[1] for view, number in enumerate(ends)], dim=1)
        """(2, views, M) int64: index of both ends of every transition in each view, with views concatenated."""

    def state_dict(self) -> dict[str, Any]:
        return {"batches": self.draws.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.draws.set_state(state["batches"])

    def sample(self) -> FeatureBatch:
        count = len(self.data)
        index = self.draws.integers(count, self.batch_size)
        view = self.draws.integers(len(self.features), self.batch_size)
        ends = self.ends.flatten(1)[:, torch.add(index, view, alpha=count)]
        return _batch(_rows(self.features.flatten(0, 1), ends), _rows(self.data, index))


class StackedSampler:
    """Batches of several runs trained as a stack, each run's own (`finetune.stack`)."""

    def __init__(self, samplers: Sequence[FeatureSampler]) -> None:
        """Start from copies of the runs' samplers, which must agree in views and batch size."""
        self._features = [sampler.features.flatten(0, 1) for sampler in samplers]
        self._shared = all(sampler.features is samplers[0].features for sampler in samplers)
        self._counts, self._views = [len(sampler.data) for sampler in samplers], len(samplers[0].features)
        self._shape = len(samplers), samplers[0].batch_size
        self.draws = stacked([sampler.draws for sampler in samplers])
        self._data = torch.cat([sampler.data for sampler in samplers])
        self._ends = torch.cat([sampler.ends for sampler in samplers], dim=2).flatten(1)
        first = [sum(self._counts[:number]) for number in range(len(samplers))]
        self._first = torch.tensor(first, device=self._data.device)[:, None]

    def sample(self) -> FeatureBatch:
        """The next batch of every run: tensors of (S, B, ...)."""
        index = self.draws.integers(self._counts, *self._shape) + self._first
        view = self.draws.integers(self._views, *self._shape)
        ends = self._ends[:, torch.add(index, view, alpha=len(self._data))]
        if self._shared:
            both = _rows(self._features[0], ends)
        else:
            pairs = zip(self._features, ends.unbind(1), strict=True)
            both = torch.stack([_rows(own, end) for own, end in pairs], dim=1)
        return _batch(both, _rows(self._data, index))


def _rows(values: Tensor, numbers: Tensor) -> Tensor:
    """`values[numbers]` of (N, D), contiguous; on a CPU several times as fast as indexing."""
    return values.index_select(0, numbers.flatten()).view(*numbers.shape, -1)


def _batch(both: Tensor, data: Tensor) -> FeatureBatch:
    """Build a batch from (2, ..., D) features of both ends and (..., 2 A + 2) actions, rewards and discounts."""
    z, next_z = both.float()
    action, next_action = data[..., :-2].chunk(2, dim=-1)
    return FeatureBatch(z, action, data[..., -2], data[..., -1], next_z, next_action)


class ExactSampler(Sampler):
    """Uniform n-step transitions whose representations are computed on the fly."""

    def __init__(
        self, frozen: FrozenEncoder, options: Options, batch_size: int, n_step: int, gamma: float,
        draws: RandomStream,
    ) -> None:  # fmt: skip
        super().__init__(frozen.view(0), batch_size, draws)
        self._frozen, self._n_step, self._gamma = frozen, n_step, gamma
        self._options = options if isinstance(options, HistoryOptions) else HistoryOptions()
        self._starts = frozen.dataset.transition_rows

    @property
    def obstacle(self) -> str:
        """Why a CUDA graph cannot capture `sample`, or ""."""
        return "--views 0 reads the lengths of histories" if self._frozen.encoder.remembers else ""

    def sample(self) -> FeatureBatch:
        """The next batch. An encoder with memory reads all rows of a transition's history or window."""
        dataset = self._frozen.dataset
        rows = self._starts[self._draw(len(self._starts))]
        reward, discount, next_rows = dataset.n_step_returns(rows, self._n_step, self._gamma)
        z, next_z = self._encode(rows, next_rows)
        next_action = dataset.action_or_zero(next_rows)
        return FeatureBatch(z, dataset.action_after(rows), reward, discount, next_z, next_action)

    @torch.no_grad()
    def _encode(self, rows: Tensor, next_rows: Tensor) -> tuple[Tensor, Tensor]:
        encoder = self._frozen.encoder
        # one shift per transition, as in a view, where an episode has one shift
        key = self.view.shifts.take((len(rows),), rows.device)
        if not encoder.remembers:
            features = self._frozen.rows(torch.cat([rows, next_rows]), key.repeat(2), self.view)
            return features[: len(rows)], features[len(rows) :]

        def frames(rows: Tensor) -> Tensor:
            """Frame features (B, T, F) of (B, T) rows, with one shift per leading index."""
            keys = key.repeat_interleave(rows.shape[1])
            return self._frozen.rows(rows.reshape(-1), keys, self.view).view(*rows.shape, -1)

        return read_both_ends(encoder, frames, self._frozen.dataset, self._first(rows), rows, next_rows)

    def _first(self, rows: Tensor) -> Tensor:
        """Rows at which the histories of (B,) rows begin."""
        dataset, window = self._frozen.dataset, self._frozen.encoder.config.history_window
        first = dataset.episode_start[dataset.episode[rows]]
        if window:
            first = torch.maximum(first, rows - window + 1)
        if not self._options.random_histories:
            return first
        random = self.draws.uniform(len(rows)) < self._options.random_histories
        shortest, longest = self._options.shortest_history, self._options.longest_history
        length = shortest + self.draws.integers(longest + 1 - shortest, len(rows))
        return torch.where(random, torch.maximum(first, rows - length + 1), first)
