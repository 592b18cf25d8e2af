"""A data set in memory: rows, episodes, and vectorised gathering of transitions and windows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.data.store import Store, open_store
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.tasks import FRAME_STACK, QUALITIES, TASKS
from vd4rl_pomdp.types import StepType, Transitions, Windows, row_key

Index = int | Sequence[int] | np.ndarray | Tensor


def open_dataset(path: Path | str, cache: Path | None = None) -> Dataset:
    """Open a V-D4RL set: a folder of shards, or one shard.

    The first opening decodes the set into the store; later ones map it and take well under a second.

    Args:
        path: folder (or file) of the shards.
        cache: where decoded sets are kept; default `$VD4RL_POMDP_CACHE`, else the user's cache folder.

    Raises:
        UserError: the set is missing, empty, damaged or incomplete.
    """
    return Dataset(Path(path), open_store(Path(path), cache))


class Dataset:
    """Rows of a V-D4RL set with their episodes. All tensors live on one device; frames are mapped until `to` moves them."""

    def __init__(self, path: Path, store: Store) -> None:
        self.path = path
        self.store = store
        self.fingerprint = store.folder.name
        self.task, self.quality = _identity(path, store)
        step_type = _required(store, "step_type")
        self.frames = torch.from_numpy(_writable_view(store.frames()))
        """(N, 3, 84, 84) uint8."""
        self.action = torch.from_numpy(_required(store, "action"))
        """(N, A) float32: row t holds a_{t-1}."""
        self.reward = torch.from_numpy(_required(store, "reward").astype(np.float32))
        """(N,) float32: row t holds r_{t-1}."""
        self.discount = torch.from_numpy(_required(store, "discount").astype(np.float32))
        self.physics = store.array("physics")
        """(N, P) float64 simulator states, or None for published sets."""
        starts = np.flatnonzero(step_type == StepType.FIRST)
        ends = np.append(starts[1:], len(step_type))
        self.episode_start, self.episode_end = torch.from_numpy(starts), torch.from_numpy(ends)
        """(E,) int64: first row of every episode, and the row after its last."""
        self.incomplete_episodes = int((step_type[ends - 1] != StepType.LAST).sum())
        lengths = self.episode_end - self.episode_start
        self.episode = torch.repeat_interleave(torch.arange(len(starts)), lengths)
        """(N,) int64: episode of every row."""
        self.t = torch.arange(len(step_type)) - self.episode_start[self.episode]
        """(N,) int64: row within its episode."""

    @property
    def num_rows(self) -> int:
        """Rows N."""
        return len(self.t)

    @property
    def num_episodes(self) -> int:
        """Episodes, incomplete ones included."""
        return len(self.episode_start)

    @property
    def num_transitions(self) -> int:
        """Rows that have a successor in their episode."""
        return self.num_rows - self.num_episodes

    @property
    def action_dim(self) -> int:
        """Action dimension A."""
        return self.action.shape[1]

    @property
    def returns(self) -> Tensor:
        """(E,) float64: undiscounted return of every episode."""
        total = torch.zeros(self.num_episodes, dtype=torch.float64, device=self.reward.device)
        inside = self.t > 0
        return total.index_add_(0, self.episode[inside], self.reward[inside].double())

    def to(self, device: torch.device | str) -> Dataset:
        """Move frames and rows to a device, in place."""
        for name in ("frames", "action", "reward", "discount", "episode_start", "episode_end", "episode", "t"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def keys(self, rows: Tensor) -> Tensor:
        """`row_key` of every row in `rows`."""
        return row_key(self.episode[rows], self.t[rows])

    def stacks(self, rows: Tensor, frame_stack: int = FRAME_STACK) -> Tensor:
        """Frame stacks (..., 3 * frame_stack, 84, 84) uint8 of (...,) rows, oldest frame first, within the episode."""
        back = torch.arange(frame_stack - 1, -1, -1, device=rows.device)
        first = self.episode_start[self.episode[rows]]
        index = torch.maximum(rows[..., None] - back, first[..., None])
        frames = self.frames.index_select(0, index.reshape(-1))
        return frames.view(*rows.shape, -1, *self.frames.shape[2:])

    def transitions(
        self, index: Index, n_step: int = 1, frame_stack: int = FRAME_STACK, gamma: float = 0.99
    ) -> Transitions:
        """Gather n-step transitions.

        Args:
            index: (B,) numbers in 0..num_transitions-1; they count the rows that have a successor, in order.
            n_step: rewards to sum; fewer at an episode's end.
            frame_stack: frames in an observation.
            gamma: discount between the summed rewards.

        Returns:
            `Transitions`. With m = min(n_step, steps left), `reward` is the sum of gamma^i r_{t+i} for i < m and
            `discount` the product of the m stored discounts times gamma^(m-1): the learner multiplies one more gamma,
            so that for n_step = 1 both are what the set holds.
        """
        rows = self._transition_rows(self._index(index, self.num_transitions))
        reward, discount, next_rows = self.n_step_returns(rows, n_step, gamma)
        return Transitions(
            obs=self.stacks(rows, frame_stack),
            action=self.action[rows + 1],
            reward=reward,
            discount=discount,
            next_obs=self.stacks(next_rows, frame_stack),
            key=self.keys(rows),
            next_key=self.keys(next_rows),
        )

    def n_step_returns(self, rows: Tensor, n_step: int, gamma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, discount (see `transitions`) and successor row of the n-step transition from each row."""
        last = self.episode_end[self.episode[rows]] - 1
        reward, discount = torch.zeros_like(self.reward[rows]), torch.ones_like(self.reward[rows])
        for i in range(n_step):
            inside = rows + i < last
            step = torch.where(inside, rows + i + 1, rows)
            reward = reward + torch.where(inside, discount * self.reward[step] * (gamma if i else 1.0), 0.0)
            discount = torch.where(inside, discount * self.discount[step] * (gamma if i else 1.0), discount)
        return reward, discount, torch.minimum(rows + n_step, last)

    def num_windows(self, length: int) -> int:
        """Windows of `length` consecutive rows of one episode; a shorter episode raises UserError."""
        return int(self._windows_per_episode(length).sum())

    def windows(self, index: Index, length: int, frame_stack: int = FRAME_STACK) -> Windows:
        """Gather windows of consecutive rows.

        Args:
            index: (B,) numbers in 0..num_windows(length)-1; they count all starts within episodes, in order.
            length: rows T of each window.
            frame_stack: frames in an observation; a stack may reach before its window, never before its episode.
        """
        per_episode = self._windows_per_episode(length)
        number = self._index(index, int(per_episode.sum()))
        ends = per_episode.cumsum(0)
        episode = torch.searchsorted(ends, number, right=True)
        start = self.episode_start[episode] + number - (ends[episode] - per_episode[episode])
        rows = start[:, None] + torch.arange(length, device=start.device)
        has_action = rows + 1 < self.episode_end[self.episode[rows]]
        action = self.action[torch.where(has_action, rows + 1, rows)] * has_action[..., None]
        prev_action = torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], dim=1)
        return Windows(
            obs=self.stacks(rows, frame_stack),
            prev_action=prev_action,
            action=action,
            has_action=has_action,
            length=torch.full_like(start, length),
            key=self.keys(rows),
        )

    def _windows_per_episode(self, length: int) -> Tensor:
        count = self.episode_end - self.episode_start - length + 1
        short = torch.nonzero(count < 1)
        if len(short):
            episode = int(short[0, 0])
            rows = int(self.episode_end[episode] - self.episode_start[episode])
            raise UserError(
                f"{self.path}: episode {episode} has {rows} rows, fewer than the window of {length}; "
                "lower --window or remove the episode"
            )
        return count

    def _transition_rows(self, number: Tensor) -> Tensor:
        """Row of every transition: each episode has one row more than transitions."""
        ends = (self.episode_end - self.episode_start - 1).cumsum(0)
        return number + torch.searchsorted(ends, number, right=True)

    def _index(self, index: Index, size: int) -> Tensor:
        number = torch.atleast_1d(torch.as_tensor(index, device=self.t.device)).long()
        if len(number) and not (0 <= int(number.min()) and int(number.max()) < size):
            raise IndexError(f"index out of range: the set has {size}")
        return number


def _required(store: Store, key: str) -> np.ndarray:
    array = store.array(key)
    assert array is not None, key
    return array


def _writable_view(frames: np.ndarray) -> np.ndarray:
    """The same memory, declared writable: torch warns about read-only arrays, and nothing writes to it."""
    return np.frombuffer(np.memmap(frames.filename, np.uint8, "c"), np.uint8).reshape(frames.shape)  # type: ignore[attr-defined]


def _identity(path: Path, store: Store) -> tuple[str | None, str | None]:
    """Task and quality: as the shards say, else as the folders are named."""
    attributes = store.meta["attributes"][0]
    parts = path.resolve().parts
    task = attributes.get("task") or next((p for p in reversed(parts) if p in TASKS), None)
    quality = attributes.get("set") or next((p for p in reversed(parts) if p in QUALITIES), None)
    return task, quality
