"""Endless uniform batches of windows or transitions, from a generator that is passed in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch

from vd4rl_pomdp.core.types import Transitions, Windows
from vd4rl_pomdp.data.dataset import Dataset, require_positive
from vd4rl_pomdp.data.view import View


class Sampler:
    """What samplers share: a view (of a set as it is stored, if a set is given), a batch size and a generator.

    The generator lives on the CPU, so the draws do not depend on the set's device.
    """

    def __init__(self, source: Dataset | View, batch_size: int, generator: torch.Generator) -> None:
        require_positive(batch_size=batch_size)
        self.view = source if isinstance(source, View) else View(source)
        self._batch_size, self._generator = batch_size, generator

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same batches."""
        return {"batches": self._generator.get_state(), "view": self.view.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self._generator.set_state(state["batches"])
        self.view.load_state_dict(state["view"])

    def _draw(self, count: int) -> torch.Tensor:
        return torch.randint(count, (self._batch_size,), generator=self._generator)


class WindowSampler(Sampler):
    """Windows whose starts are uniform over the set, drawn with replacement."""

    def __init__(self, source: Dataset | View, batch_size: int, length: int, generator: torch.Generator) -> None:
        super().__init__(source, batch_size, generator)
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
        generator: torch.Generator,
        n_step: int = 1,
        gamma: float = 0.99,
    ) -> None:
        super().__init__(source, batch_size, generator)
        require_positive(n_step=n_step)
        self.view.dataset.require_transitions()
        self._n_step, self._gamma = n_step, gamma

    def sample(self) -> Transitions:
        """The next batch, on the data set's device."""
        return self.view.transitions(self._draw(self.view.dataset.num_transitions), self._n_step, self._gamma)

    def __iter__(self) -> Iterator[Transitions]:
        while True:
            yield self.sample()
