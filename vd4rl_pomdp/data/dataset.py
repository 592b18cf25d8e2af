"""A data set in memory: rows, episodes, and index arithmetic. `View` turns rows into observations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.errors import OutOfMemoryError, UserError, refuse_number
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.types import StepType, row_key, unpack_row_key
from vd4rl_pomdp.data.folder import episode_returns, task_and_quality
from vd4rl_pomdp.data.store import Store, open_store
from vd4rl_pomdp.envs.make import layout_of

Index = int | Sequence[int] | np.ndarray | Tensor


def open_dataset(path: Path | str, cache: Path | str | None = None) -> Dataset:
    """Open a V-D4RL data set: a folder of shards, or a single shard.

    The first call decodes it into `cache`, by default `$VD4RL_POMDP_CACHE` or the user's cache folder; later calls
    memory-map that. UserError for one that is missing, damaged, incomplete, or with frames of two sizes.
    """
    path = Path(path)
    return Dataset(path, open_store(path, Path(cache) if cache else None))


class Dataset:
    """Rows and episodes of a V-D4RL data set, all tensors on one device; create it with `open_dataset`."""

    def __init__(self, path: Path, store: Store) -> None:
        self.path = path
        self.store = store
        self._windows: dict[int, tuple[int, Tensor]] = {}
        """Window length -> number of windows, and cumulative number per episode, (E,) int64. A cache: computing it
        synchronises with the GPU."""
        self.fingerprint = store.fingerprint
        """Content hash of the data set."""
        self.task, self.quality = task_and_quality(path, store.meta["attributes"])
        """Task and quality by name; None if neither the shards nor the folder state them."""
        self.imported = all("imported" in one for one in store.meta["attributes"])
        """Whether it was written by `data import`; its task may then have no environment."""
        step_type, reward = store.array("step_type"), store.array("reward")
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")  # it is only read
            self.frames = torch.from_numpy(store.frames())
        """(N, 3, S, S) uint8; until `to`, a read-only memory map shared with other processes: writing to it crashes."""
        self.action = torch.from_numpy(store.array("action"))
        """(N, A) float32: row t holds a_{t-1}."""
        self.reward = torch.from_numpy(reward.astype(np.float32))
        """(N,) float32: row t holds r_{t-1}."""
        self.discount = torch.from_numpy(store.array("discount").astype(np.float32))
        """(N,) float32: row t holds the discount of the step that led to it."""
        self.step_type = torch.from_numpy(step_type)
        """(N,) uint8: `types.StepType`."""
        self.physics = store.physics()
        """(N, P) float64 simulator states (numpy, on the CPU), or None for published sets."""
        starts = np.flatnonzero(step_type == StepType.FIRST)
        ends = np.append(starts[1:], len(step_type))
        self.episode_start, self.episode_end = torch.from_numpy(starts), torch.from_numpy(ends)
        """(E,) int64: first row of every episode, and one past its last row."""
        self.incomplete_episodes = int((step_type[ends - 1] != StepType.LAST).sum())
        """Number of episodes without a LAST row; they are used like the others."""
        lengths = self.episode_end - self.episode_start
        self.episode = torch.repeat_interleave(torch.arange(len(starts)), lengths)
        """(N,) int64: episode of every row."""
        self.t = torch.arange(len(step_type)) - self.episode_start[self.episode]
        """(N,) int64: step of every row within its episode, from 0."""
        self.transition_rows = torch.nonzero(self.t[1:] > 0)[:, 0]
        """(M,) int64: rows with a successor in their episode, in order."""
        self.returns = torch.from_numpy(episode_returns(reward, starts))
        """(E,) float64: undiscounted return of every episode."""

    @property
    def num_rows(self) -> int:
        return len(self.t)

    @property
    def num_episodes(self) -> int:
        """Number of episodes, incomplete ones included."""
        return len(self.episode_start)

    @property
    def num_transitions(self) -> int:
        """Number of rows with a successor in their episode."""
        return self.num_rows - self.num_episodes

    @property
    def frame_size(self) -> int:
        return self.frames.shape[-1]

    def require_transitions(self) -> None:
        if not self.num_transitions:
            raise UserError(
                f"{self.path}: holds no transitions, since every episode has a single row: choose another dataset"
            )

    @property
    def action_dim(self) -> int:
        return self.action.shape[1]

    def require_states(self) -> tuple[np.ndarray, str]:
        """Simulator states (N, P) float64 and the task's name; UserError if the data set lacks one of them."""
        if self.physics is None:
            raise UserError(
                f"{self.path}: stores no simulator states; `data collect` stores those of dm_control's tasks"
            )
        if self.task is None:
            raise UserError(f"{self.path}: has physics but no task name; put it in a folder named after its task")
        return self.physics, self.task

    def rows_of(self, episode: int | range) -> slice:
        """Rows of one episode, or of a range of consecutive episodes."""
        first, last = (episode, episode) if isinstance(episode, int) else (episode[0], episode[-1])
        return slice(int(self.episode_start[first]), int(self.episode_end[last]))

    def states(self) -> Tensor:
        """Poses and velocities (N, P') float32, on the data set's device; UserError if it has no states."""
        physics, task = self.require_states()
        return torch.from_numpy(layout_of(TASKS.named(task)).visible_state(physics)).to(self.t.device)

    def state_scale(self) -> StateScale:
        """Means and standard deviations of `states`, on the CPU; UserError if the data set has no states."""
        physics, task = self.require_states()
        pose = layout_of(TASKS.named(task)).pose(physics[:1])
        return StateScale.fit(self.states().cpu(), pose.shape[1])

    def to(self, device: torch.device | str) -> Dataset:
        """Move frames and rows to a device, in place; UserError if its memory is too small."""
        try:
            for name, value in vars(self).items():
                if isinstance(value, Tensor):
                    setattr(self, name, value.to(device))
            self._windows = {length: (count, ends.to(device)) for length, (count, ends) in self._windows.items()}
        except torch.OutOfMemoryError as error:
            raise OutOfMemoryError(
                f"{self.path}: {self.frames.nbytes / 1e9:.1f} GB of frames exceed the free memory of {device}: "
                "choose --device cpu, a smaller dataset, or fewer runs per GPU"
            ) from error
        return self

    def keys(self, rows: Tensor) -> Tensor:
        """`row_key`s (...,) int64 of rows (...,) int64."""
        return row_key(self.episode[rows], self.t[rows])

    def rows(self, key: Tensor) -> Tensor:
        """Rows (...,) int64 of `row_key`s (...,) int64; the inverse of `keys`."""
        episode, t = unpack_row_key(key)
        return self.episode_start[episode] + t

    def action_after(self, rows: Tensor) -> Tensor:
        """a_t (..., A) float32 of (...,) int64 rows t, which must have a successor."""
        return self.action[rows + 1]

    def action_or_zero(self, rows: Tensor) -> Tensor:
        """a_t (..., A) float32 of any (...,) int64 rows t; zero at an episode's last row, which has no action."""
        last = (self.episode_end - 1)[self.episode[rows]]
        return self.action[torch.minimum(rows + 1, last)] * (rows < last)[..., None]

    def actions_before(self, rows: Tensor) -> Tensor:
        """a_{t-1} (..., T, A) float32 of (..., T) consecutive rows; zero at the first, where the history starts."""
        actions = self.action[rows]
        actions[..., 0, :] = 0  # the stored action was taken before the window
        return actions

    def stack_rows(self, rows: Tensor, frame_stack: int) -> Tensor:
        """Rows (..., frame_stack) int64 of the frames in each row's stack, oldest first.

        At the start of an episode its first frame is repeated. IndexError for a negative row.
        """
        if hardware.in_host_memory(rows) and (rows < 0).any():  # on a GPU the check would synchronise
            raise IndexError(f"row {int(rows.min())} is out of range for a set of {self.num_rows} rows")
        back = torch.arange(frame_stack - 1, -1, -1, device=rows.device)
        first = self.episode_start[self.episode[rows]]
        return torch.maximum(rows[..., None] - back, first[..., None])

    def rows_of_transitions(self, index: Index) -> Tensor:
        """Rows (B,) int64 of transition numbers (B,) in 0..num_transitions-1; IndexError if out of range."""
        return self.transition_rows[self._index(index, self.num_transitions)]

    def n_step_returns(self, rows: Tensor, n_step: int, gamma: float) -> tuple[Tensor, Tensor, Tensor]:
        """n-step reward and discount (B,) float32 and successor row (B,) int64 of rows (B,) int64.

        With m = min(n_step, steps left) and d_i the product of the first i stored discounts, the reward is the sum of
        gamma^i d_i r_{t+i} over i < m, and the discount is gamma^(m-1) d_m. The learner multiplies by gamma once more
        (acme's convention), for any m; so for n_step = 1 both are as stored. For an episode's last row, which has no
        successor, the result is 0, 1 and the row itself.
        """
        refuse_number("n_step", n_step, 1)
        refuse_number("gamma", gamma, 0, 1)
        # Row t + 1 stores the reward of step t: sum rows t + 1 .. t + m, up to the episode's last row.
        last = (self.episode_end - 1)[self.episode[rows]]
        step = torch.arange(n_step, device=rows.device)
        inside = rows[:, None] + step < last[:, None]
        paid = torch.minimum(rows[:, None] + step + 1, last[:, None])
        discount = torch.where(inside, self.discount[paid], 1.0).cumprod(1)
        before = torch.cat([torch.ones_like(discount[:, :1]), discount[:, :-1]], 1)
        reward = (self.reward[paid] * before * gamma**step * inside).sum(1)
        return reward, discount[:, -1] * gamma ** (inside.sum(1) - 1).clamp(min=0), self.successors(rows, n_step)

    def successors(self, rows: Tensor, n_step: int) -> Tensor:
        """Rows (B,) int64 that are `n_step` after the given ones, or their episode's last row."""
        return torch.minimum(rows + n_step, (self.episode_end - 1)[self.episode[rows]])

    def num_windows(self, length: int) -> int:
        """Number of windows of `length` consecutive rows within an episode; errors as `check_windows`."""
        if length not in self._windows:
            self.check_windows(length)
            ends = self.windows_per_episode(length).cumsum(0)
            self._windows[length] = int(ends[-1]), ends
        return self._windows[length][0]

    def window_rows(self, index: Index, length: int) -> Tensor:
        """Rows (B, length) int64 of windows; errors as `check_windows`, and IndexError for an index out of range.

        `index` (B,) are window numbers in 0..num_windows(length)-1, counting all possible starts in order.
        """
        count, ends = self.num_windows(length), self._windows[length][1]
        number, per_episode = self._index(index, count), self.windows_per_episode(length)
        # Window numbers run through all episodes; the cumulative counts `ends` locate a number's episode.
        episode = torch.searchsorted(ends, number, right=True)
        start = self.episode_start[episode] + number - (ends - per_episode)[episode]
        return start[:, None] + torch.arange(length, device=start.device)

    def check_windows(self, length: int) -> None:
        """Raise UserError if an episode with at least one transition is shorter than `length` rows.

        Episodes of a single row have nothing to train on; `window_rows` skips them.
        """
        refuse_number("length", length, 1)
        self.require_transitions()
        rows = self.episode_end - self.episode_start
        short = torch.nonzero((rows < length) & (rows > 1))[:, 0]
        if len(short):
            episode = int(short[0])
            raise UserError(
                f"{self.path}: episode {episode} has {rows[episode]} rows, fewer than the window of {length} "
                f"({len(short)} such episodes); choose a window of at most {rows[short].min()}, or leave "
                f"them out: `vd4rl-pomdp data import vd4rl {self.path} NEW --shortest {length}`"
            )

    @property
    def longest_episode(self) -> int:
        return int(self.t.max()) + 1

    def windows_per_episode(self, length: int) -> Tensor:
        """Number of windows of `length` rows in each episode, (E,) int64; for 2, the number of transitions."""
        return (self.episode_end - self.episode_start - (length - 1)).clamp(min=0)

    def _index(self, index: Index, size: int) -> Tensor:
        """Convert `index` to (B,) int64 on the data set's device; its range is checked only if it is on the CPU."""
        if isinstance(index, np.ndarray):
            index = index.copy()  # torch rejects negative strides and warns about read-only memory
        number = torch.atleast_1d(torch.as_tensor(index))
        if not number.numel():
            return torch.zeros(0, dtype=torch.int64, device=self.t.device)
        if number.is_floating_point() or number.dtype == torch.bool or number.ndim != 1:
            raise IndexError(f"an index is an integer or a flat list of them, not {number.dtype} of {number.ndim} axes")
        number = number.to(torch.int64)
        if hardware.in_host_memory(number):
            low, high = int(number.min()), int(number.max())
            if low < 0 or high >= size:
                raise IndexError(f"index {low if low < 0 else high} is outside 0..{size - 1}")
        # non_blocking only towards a GPU: the CPU could read before a copy to it has arrived
        return number.to(self.t.device, non_blocking=self.t.device.type != "cpu")
