"""A data set as an agent sees it: stacked frames, shifted at random, then corrupted; and batches of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, get_args

import torch
from torch import Tensor

from vd4rl_pomdp.core import buffers
from vd4rl_pomdp.core.buffers import BUFFERS
from vd4rl_pomdp.core.errors import refuse_number, refuse_unknown
from vd4rl_pomdp.core.seeding import stream_seed
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.core.tasks import FRAME_STACK
from vd4rl_pomdp.core.types import Transitions, Windows
from vd4rl_pomdp.corruptions import BatchCorruption, CorruptionConfig, KeyStream, augmentation
from vd4rl_pomdp.corruptions.augmentation import Sharing
from vd4rl_pomdp.data.dataset import Dataset, Index


class View:
    """A set, the shift and the corruption under which it is seen, and the streams that both are drawn from."""

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
        """See the class.

        Args:
            dataset: the set; moving it to a device moves what the view shows.
            corruption: what makes the observations partial, or its name; None for nothing.
            shift: largest random shift in pixels.
            seed: the run's seed.
            name: tells the views of a run apart: each draws from streams of its own.
            frame_stack: frames in an observation.
            shared: what one shift is shared by.
        """
        refuse_unknown("sharing", shared, get_args(Sharing))
        refuse_number("frame_stack", frame_stack, 1)
        self.dataset = dataset
        self.corruption = BatchCorruption(corruption or CorruptionConfig(), seed, *name)
        self.shifts = KeyStream(stream_seed(seed, "shift", *name))
        self._pad, self._frame_stack, self._shared = shift, frame_stack, shared

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """Observations of rows. On a CPU, under a shift, frames that the corruption zeroes are never read.

        Args:
            rows: (N, ...) int64; everything under one leading index is shifted alike, unless shifts are shared by the
                frames of one observation alone.
            shift_key: (N,) int64, what the shifts are drawn from; None: the next keys of the view's stream.

        Returns:
            (N, ..., C, H, W) uint8, C = 3 * frame_stack.
        """
        if shift_key is None:
            shifts = len(rows) if self._shared == "window" else rows.numel()
            shift_key = self.shifts.take((shifts,), rows.device)
        # Keys are taken whichever way is gone: the streams stand alike on every device.
        keys = self.corruption.keys(self.dataset.keys(rows))
        frames = self.dataset.frames
        if augmentation.by_lines(frames, self._pad):
            return self._observe_by_lines(rows, shift_key, keys)
        if not buffers.in_host_memory(frames):
            index = self.dataset.stack_rows(rows, self._frame_stack).view(-1, self._frame_stack)
            obs = self.corruption.corruption.paint(frames, index, keys.flatten(), shift_key, self._pad)
            if obs is not None:
                return obs.view(*rows.shape, *obs.shape[1:])
        stacks = self.stacks(rows)
        shifted_alike = stacks if len(shift_key) == len(rows) else stacks.flatten(0, rows.ndim - 1)
        shifted = augmentation.random_shift(shifted_alike, shift_key, self._pad).view(stacks.shape)
        return self.corruption.corruption.apply_(shifted, keys)

    def stacks(self, rows: Tensor) -> Tensor:
        """(..., C, H, W) uint8 frame stacks of (...,) int64 rows as they are stored, neither shifted nor corrupted."""
        frames = self.dataset.frames
        index = self.dataset.stack_rows(rows, self._frame_stack).flatten()
        out = BUFFERS.take((len(index), *frames.shape[1:])) if buffers.in_host_memory(frames) else None
        stored = torch.index_select(frames, 0, index, out=out)
        return stored.view(*rows.shape, frames.shape[1] * self._frame_stack, *frames.shape[2:])

    def windows(self, index: Index, length: int) -> Windows:
        """The windows that `Dataset.window_rows` numbers, as the agent sees them; none of them is padded.

        A stack may reach before its window, never before its episode. `action` of the last row is the next row's,
        outside the window, if there is one.
        """
        data, rows = self.dataset, self.dataset.window_rows(index, length)
        has_action = rows + 1 < data.episode_end[data.episode[rows]]
        # Without an action, row 0 stands in (it has one) and is multiplied away: no branch, no wait for a GPU.
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
        """From (B,) int64 rows `first` on to the ends of their episodes, at most `length` rows, the rest is padding.

        They are shown by their first observation alone: `obs` repeats it, in the memory of one.
        """
        data = self.dataset
        end = data.episode_end[data.episode[first], None]
        there = first[:, None] + torch.arange(length, device=first.device)
        rows, obs = torch.minimum(there, end - 1), self.observe(first[:, None])
        return Windows(
            obs=obs.expand(-1, length, *obs.shape[2:]),
            prev_action=data.actions_before(rows) * (there < end)[..., None],
            action=data.action_or_zero(rows),
            has_action=there + 1 < end,
            length=(end[:, 0] - first).clamp(max=length),
            key=data.keys(rows),
        )

    def transitions(self, index: Index, n_step: int = 1, gamma: float = 0.99) -> Transitions:
        """The n-step transitions that `index` numbers, as the agent sees them.

        Both ends are shifted and corrupted on their own.

        Args:
            index: (B,) numbers in 0..num_transitions-1; they count the rows that have a successor, in order.
            n_step: rewards to sum, as `Dataset.n_step_returns` does; fewer at an episode's end.
            gamma: discount between the summed rewards.

        Raises:
            IndexError: an index is out of range.
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
        """Where the streams stand."""
        return {"corruption": int(self.corruption.stream.position), "shift": int(self.shifts.position)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.corruption.stream.go_to(state["corruption"])
        self.shifts.go_to(state["shift"])

    def _observe_by_lines(self, rows: Tensor, shift_key: Tensor, keys: Tensor) -> Tensor:
        """The same for a set on a CPU: only frames that stay are read, shifted, changed, and put into their stacks."""
        corruption, frames, stack = self.corruption.corruption, self.dataset.frames, self._frame_stack
        keys = keys.flatten()
        kept = corruption.kept(keys, stack)
        chosen = self.dataset.stack_rows(rows, stack).view(-1, stack).gather(1, kept)
        # One image more than are chosen: the frame of zeros that `_spread` reads.
        images = BUFFERS.take((chosen.numel() + 1, *frames.shape[1:]))
        # All frames under one key lie one after the other.
        offset = augmentation.draw_offset(shift_key, self._pad).repeat_interleave(
            chosen.numel() // max(1, len(shift_key)), 0
        )
        augmentation.shift_by_lines(frames, chosen.flatten(), offset, images[:-1])
        corruption.change_(images[:-1].view(*chosen.shape, *images.shape[1:]), keys, kept)
        obs = images[:-1] if kept.shape[1] == stack else _spread(images, kept, stack)
        return obs.view(*rows.shape, stack * images.shape[1], *images.shape[2:])


class StateView(View):
    """Simulator states in place of pixels, as an encoder of states observes them."""

    def __init__(
        self,
        dataset: Dataset,
        observed: Callable[[Tensor, Tensor], Tensor],
        corruption: CorruptionConfig,
        seed: int,
        *name: str | int,
    ) -> None:
        """See the class.

        Args:
            dataset: a set with simulator states.
            observed: observations (..., P, 1, 1) of (..., P) states and (...,) int64 keys, `StateFrame.observe`.
            corruption: keys are drawn as its are; its stages, which change pixels, play no part.
            seed: the run's seed.
            name: tells the views of a run apart.
        """
        super().__init__(dataset, corruption, 0, seed, *name)
        self._states, self._observed = dataset.states(), observed

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """(..., P, 1, 1) float32 of (...,) int64 rows; nothing is shifted."""
        return self._observed(self._states[rows], self.corruption.keys(self.dataset.keys(rows)))


def _spread(images: Tensor, kept: Tensor, stack: int) -> Tensor:
    """Put frames at their (N, K) places in stacks of zeros; `images` has room for one of zeros behind them."""
    images[-1] = 0
    source = torch.full((len(kept), stack), kept.numel())
    source.scatter_(1, kept, torch.arange(kept.numel()).view(kept.shape))
    out = BUFFERS.take((source.numel(), *images.shape[1:]))
    return torch.index_select(images, 0, source.flatten(), out=out)


class Sampler:
    """What samplers share: a view (of a set as it is stored, if a set is given), a batch size and a random stream.

    The stream is drawn on the CPU, so the batches do not depend on the set's device.
    """

    def __init__(self, source: Dataset | View, batch_size: int, draws: RandomStream) -> None:
        refuse_number("batch_size", batch_size, 1)
        self.view = source if isinstance(source, View) else View(source)
        self._batch_size, self.draws = batch_size, draws

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same batches."""
        return {"batches": self.draws.get_state(), "view": self.view.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.draws.set_state(state["batches"])
        self.view.load_state_dict(state["view"])

    def _draw(self, count: int) -> torch.Tensor:
        return self.draws.integers(count, self._batch_size)


class WindowSampler(Sampler):
    """Windows whose starts are uniform over the set, drawn with replacement."""

    def __init__(self, source: Dataset | View, batch_size: int, length: int, draws: RandomStream) -> None:
        super().__init__(source, batch_size, draws)
        self._length, self._count = length, self.view.dataset.num_windows(length)

    def sample(self) -> Windows:
        """The next batch, on the data set's device."""
        return self.view.windows(self._draw(self._count), self._length)

    def __iter__(self) -> Iterator[Windows]:
        while True:
            yield self.sample()


class TransitionSampler(Sampler):
    """n-step transitions uniform over the set, drawn with replacement."""

    def __init__(
        self,
        source: Dataset | View,
        batch_size: int,
        draws: RandomStream,
        n_step: int = 1,
        gamma: float = 0.99,
    ) -> None:
        super().__init__(source, batch_size, draws)
        refuse_number("n_step", n_step, 1)
        self.view.dataset.require_transitions()
        self._n_step, self._gamma = n_step, gamma

    def sample(self) -> Transitions:
        """The next batch, on the data set's device."""
        return self.view.transitions(self._draw(self.view.dataset.num_transitions), self._n_step, self._gamma)

    def __iter__(self) -> Iterator[Transitions]:
        while True:
            yield self.sample()
