"""Views and samplers: a data set as an agent sees it (stacked, randomly shifted, then corrupted), in batches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, get_args

import torch
from torch import Tensor

from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.errors import refuse_number, refuse_unknown
from vd4rl_pomdp.core.hardware import BUFFERS
from vd4rl_pomdp.core.streams import RandomStream, stream_seed
from vd4rl_pomdp.core.tasks import FRAME_STACK
from vd4rl_pomdp.core.types import Transitions, Windows
from vd4rl_pomdp.corruptions import BatchCorruption, CorruptionConfig, KeyStream, augmentation
from vd4rl_pomdp.corruptions.augmentation import Sharing
from vd4rl_pomdp.data.dataset import Dataset, Index


class View:
    """A data set with the random shift and corruption applied to its observations, and their random streams.

    Args:
        shift: largest random shift in pixels.
        name: name of the view's random streams, which distinguishes the views of a run.
        frame_stack: frames per observation.
        shared: whether all observations of a window get the same shift, or only the frames of one observation.
    """

    def __init__(
        self,
        dataset: Dataset,
        corruption: CorruptionConfig | str | None = None,
        shift: int = 0,
        seed: int = 0,
        *name: str | int,
        frame_stack: int = FRAME_STACK,
        shared: Sharing = "window",
    ) -> None:
        refuse_unknown("sharing", shared, get_args(Sharing))
        refuse_number("frame_stack", frame_stack, 1)
        refuse_number("shift", shift, 0)
        self.dataset = dataset
        self.corruption = BatchCorruption(corruption or CorruptionConfig(), seed, *name)
        self.shifts = KeyStream(stream_seed(seed, "shift", *name))
        self._pad, self._frame_stack, self._shared = shift, frame_stack, shared

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """Observations (N, ..., C, H, W) uint8, C = 3 * frame_stack, of rows (N, ...) int64.

        `shift_key` are (N,) int64 keys of the shifts; None: the next of the view's stream. On a CPU, with a
        shift, frames that the corruption zeroes are never read.
        """
        if shift_key is None:
            shifts = len(rows) if self._shared == "window" else rows.numel()
            shift_key = self.shifts.take((shifts,), rows.device)
        # Take the keys before branching, so that the streams advance equally on every device.
        keys = self.corruption.keys(self.dataset.keys(rows))
        frames = self.dataset.frames
        if augmentation.by_lines(frames, self._pad):
            return self._observe_by_lines(rows, shift_key, keys)
        if not hardware.in_host_memory(frames):
            index = self.dataset.stack_rows(rows, self._frame_stack).reshape(-1, self._frame_stack)
            obs = self.corruption.corruption.paint(frames, index, keys.flatten(), shift_key, self._pad)
            if obs is not None:
                return obs.view(*rows.shape, *obs.shape[1:])
        stacks = self.stacks(rows)
        shifted_alike = stacks if len(shift_key) == len(rows) else stacks.flatten(0, rows.ndim - 1)
        shifted = augmentation.random_shift(shifted_alike, shift_key, self._pad).view(stacks.shape)
        return self.corruption.corruption.apply_(shifted, keys)

    def stacks(self, rows: Tensor) -> Tensor:
        """Stored frame stacks (..., C, H, W) uint8 of (...,) int64 rows, neither shifted nor corrupted."""
        frames = self.dataset.frames
        index = self.dataset.stack_rows(rows, self._frame_stack).flatten()
        out = BUFFERS.take((len(index), *frames.shape[1:])) if hardware.in_host_memory(frames) else None
        stored = torch.index_select(frames, 0, index, out=out)
        return stored.view(*rows.shape, frames.shape[1] * self._frame_stack, *frames.shape[2:])

    def windows(self, index: Index, length: int) -> Windows:
        """Windows with numbers `index` (see `Dataset.window_rows`), shifted and corrupted; none is padded.

        A frame stack may extend before its window, but not before its episode. `action` at the window's last row comes
        from the row after the window, if the episode has one.
        """
        data, rows = self.dataset, self.dataset.window_rows(index, length)
        has_action = rows + 1 < data.episode_end[data.episode[rows]]
        # Rows without an action use row 0's, multiplied by 0: no branch, so no synchronisation with a GPU.
        following = data.action_after(torch.where(has_action, rows, 0))
        return Windows(
            obs=self.observe(rows),
            prev_action=data.actions_before(rows),
            action=following * has_action[..., None],
            has_action=has_action,
            length=torch.full_like(rows[:, 0], length),
            key=data.keys(rows),
        )

    def histories(self, first: Tensor, length: int) -> Windows:
        """Rows from `first` (B,) int64 to the episode's end, at most `length`, padded to `length`.

        Only the first observation is rendered: `obs` repeats it for all rows, as an expanded view without copies.
        """
        data = self.dataset
        end = data.episode_end[data.episode[first], None]
        unpadded = first[:, None] + torch.arange(length, device=first.device)
        rows, obs = torch.minimum(unpadded, end - 1), self.observe(first[:, None])
        return Windows(
            obs=obs.expand(-1, length, *obs.shape[2:]),
            prev_action=data.actions_before(rows) * (unpadded < end)[..., None],
            action=data.action_or_zero(rows),
            has_action=unpadded + 1 < end,
            length=(end[:, 0] - first).clamp(max=length),
            key=data.keys(rows),
        )

    def transitions(self, index: Index, n_step: int = 1, gamma: float = 0.99) -> Transitions:
        """n-step transitions; `obs` and `next_obs` are shifted and corrupted independently.

        `index` (B,) are transition numbers in 0..num_transitions-1, counting the rows with a successor, in order;
        IndexError for others. `n_step` and `gamma` as in `Dataset.n_step_returns`.
        """
        data, rows = self.dataset, self.dataset.rows_of_transitions(index)
        reward, discount, next_rows = data.n_step_returns(rows, n_step, gamma)
        return Transitions(
            obs=self.observe(rows),
            action=data.action_after(rows),
            reward=reward,
            discount=discount,
            next_obs=self.observe(next_rows),
            key=data.keys(rows),
            next_key=data.keys(next_rows),
            next_action=data.action_or_zero(next_rows),
        )

    def state_dict(self) -> dict[str, Any]:
        return {"corruption": int(self.corruption.stream.position), "shift": int(self.shifts.position)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.corruption.stream.go_to(state["corruption"])
        self.shifts.go_to(state["shift"])

    def _observe_by_lines(self, rows: Tensor, shift_key: Tensor, keys: Tensor) -> Tensor:
        """`observe` for a data set on a CPU: reads, shifts and corrupts only frames that are not zeroed."""
        corruption, frames, stack = self.corruption.corruption, self.dataset.frames, self._frame_stack
        keys = keys.flatten()
        kept = corruption.kept(keys, stack)
        chosen = self.dataset.stack_rows(rows, stack).reshape(-1, stack).gather(1, kept)
        # One more image than chosen: the zero frame.
        images = BUFFERS.take((chosen.numel() + 1, *frames.shape[1:]))
        # Frames with the same shift key are consecutive.
        repeats = chosen.numel() // max(1, len(shift_key))
        offset = augmentation.draw_offset(shift_key, self._pad).repeat_interleave(repeats, 0)
        obs = images[:-1]
        augmentation.shift_by_lines(frames, chosen.flatten(), offset, obs)
        corruption.change_(obs.view(*chosen.shape, *images.shape[1:]), keys, kept)
        if kept.shape[1] < stack:  # put the frames at their places `kept` (N, K) of otherwise zero stacks
            images[-1] = 0
            source = torch.full((len(kept), stack), kept.numel())
            source.scatter_(1, kept, torch.arange(kept.numel()).view(kept.shape))
            out = BUFFERS.take((source.numel(), *images.shape[1:]))
            obs = torch.index_select(images, 0, source.flatten(), out=out)
        return obs.view(*rows.shape, stack * images.shape[1], *images.shape[2:])


class StateView(View):
    """Simulator states instead of pixels, as the input of an encoder of states.

    `observed` is `StateFrame.observe`: (..., P) states and (...,) int64 keys -> (..., P, 1, 1) observations. Of the
    corruption only its mode is used, to draw the keys; its stages change pixels.
    """

    def __init__(
        self,
        dataset: Dataset,
        observed: Callable[[Tensor, Tensor], Tensor],
        corruption: CorruptionConfig,
        seed: int,
        *name: str | int,
    ) -> None:
        super().__init__(dataset, corruption, 0, seed, *name)
        self._states, self._observed = dataset.states(), observed

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """Observations (..., P, 1, 1) float32 of (...,) int64 rows; there is no shift."""
        return self._observed(self._states[rows], self.corruption.keys(self.dataset.keys(rows)))


class Sampler(ABC):
    """Samples batches uniformly over the data set, with replacement; its state is all that later batches depend on.

    Random numbers are drawn on the CPU, so the batches do not depend on the data set's device.
    """

    def __init__(self, source: Dataset | View, batch_size: int, draws: RandomStream | torch.Generator) -> None:
        refuse_number("batch_size", batch_size, 1)
        self.view = source if isinstance(source, View) else View(source)
        self._batch_size = batch_size
        self.draws = RandomStream(draws) if isinstance(draws, torch.Generator) else draws

    def state_dict(self) -> dict[str, Any]:
        return {"batches": self.draws.get_state(), "view": self.view.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.draws.set_state(state["batches"])
        self.view.load_state_dict(state["view"])

    def _draw(self, count: int) -> Tensor:
        return self.draws.integers(count, self._batch_size)

    @abstractmethod
    def sample(self) -> Any:
        """The next batch, on the data set's device."""

    def __iter__(self) -> Iterator[Any]:
        while True:
            yield self.sample()


class WindowSampler(Sampler):
    """Samples windows of `length` rows."""

    def __init__(
        self, source: Dataset | View, batch_size: int, length: int, draws: RandomStream | torch.Generator
    ) -> None:
        super().__init__(source, batch_size, draws)
        self._length, self._count = length, self.view.dataset.num_windows(length)

    def sample(self) -> Windows:
        return self.view.windows(self._draw(self._count), self._length)


class TransitionSampler(Sampler):
    """Samples n-step transitions."""

    def __init__(
        self,
        source: Dataset | View,
        batch_size: int,
        draws: RandomStream | torch.Generator,
        n_step: int = 1,
        gamma: float = 0.99,
    ) -> None:
        super().__init__(source, batch_size, draws)
        refuse_number("n_step", n_step, 1)
        refuse_number("gamma", gamma, 0, 1)
        self.view.dataset.require_transitions()
        self._n_step, self._gamma = n_step, gamma

    def sample(self) -> Transitions:
        return self.view.transitions(self._draw(self.view.dataset.num_transitions), self._n_step, self._gamma)
