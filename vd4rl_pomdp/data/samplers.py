"""Endless uniform batches of windows or transitions, from a generator that is passed in."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from vd4rl_pomdp.data.dataset import Dataset, Observe, require_positive
from vd4rl_pomdp.tasks import FRAME_STACK
from vd4rl_pomdp.types import Transitions, Windows


class WindowSampler:
    """Windows whose starts are uniform over the set, drawn with replacement.

    `generator` lives on the CPU, so the draws do not depend on the data set's device; its state is the sampler's state.
    `observe` makes observations of rows, in place of the plain stacks.
    """

    def __init__(
        self,
        dataset: Dataset,
        batch_size: int,
        length: int,
        generator: torch.Generator,
        frame_stack: int = FRAME_STACK,
        observe: Observe | None = None,
    ) -> None:
        require_positive(batch_size=batch_size)
        self._dataset, self._batch_size, self._length = dataset, batch_size, length
        self._generator, self._frame_stack, self._observe = generator, frame_stack, observe
        self._count = dataset.num_windows(length)

    def sample(self) -> Windows:
        """The next batch, on the data set's device."""
        index = torch.randint(self._count, (self._batch_size,), generator=self._generator)
        return self._dataset.windows(index, self._length, self._frame_stack, self._observe)

    def __iter__(self) -> Iterator[Windows]:
        while True:
            yield self.sample()


class TransitionSampler:
    """Transitions uniform over the set, drawn with replacement; for the rest see `WindowSampler`."""

    def __init__(
        self,
        dataset: Dataset,
        batch_size: int,
        generator: torch.Generator,
        n_step: int = 1,
        frame_stack: int = FRAME_STACK,
        gamma: float = 0.99,
        observe: Observe | None = None,
    ) -> None:
        dataset.require_transitions()
        require_positive(batch_size=batch_size, n_step=n_step)
        self._dataset, self._batch_size, self._generator = dataset, batch_size, generator
        self._n_step, self._frame_stack, self._gamma, self._observe = n_step, frame_stack, gamma, observe

    def sample(self) -> Transitions:
        """The next batch, on the data set's device."""
        index = torch.randint(self._dataset.num_transitions, (self._batch_size,), generator=self._generator)
        return self._dataset.transitions(index, self._n_step, self._frame_stack, self._gamma, self._observe)

    def __iter__(self) -> Iterator[Transitions]:
        while True:
            yield self.sample()
