"""One training loop for pixels, states and mazes: an objective, what gives its batches, and Adam."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from pretrain.config import TrainingConfig
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.objective import Objective
from vd4rl_pomdp.runs.device import autocast
from vd4rl_pomdp.runs.loop import training
from vd4rl_pomdp.runs.run import RunFolder


class Batches(Protocol):
    """Endless batches of windows."""

    def sample(self) -> Windows:
        """The next batch, as the objective is to see it."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume with the same batches."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""


class Trainer:
    """Knows no method by name: sample, compute the loss, step. Resumes to the bit on a CPU."""

    def __init__(
        self,
        objective: Objective,
        batches: Batches,
        config: TrainingConfig,
        learning_rate: Callable[[int], float] | None = None,
    ) -> None:
        """Nothing is trained yet.

        Args:
            objective: what is trained, on its device.
            batches: on the same device.
            config: the stage's settings.
            learning_rate: of a step, the first being 0; None: the config's for all.
        """
        self.objective, self.batches, self.config, self._learning_rate = objective, batches, config, learning_rate
        self.device = next(objective.parameters()).device
        self.optimiser = torch.optim.Adam(objective.parameters(), lr=config.learning_rate)
        self.step = 0

    def update(self) -> dict[str, Tensor]:
        """One gradient step; returns the objective's scalars."""
        window = self.batches.sample()
        with autocast(self.device, self.config.precision):
            loss, logs = self.objective.loss(window, self.step / max(1, self.config.steps))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if self._learning_rate is not None:
            for group in self.optimiser.param_groups:
                group["lr"] = self._learning_rate(self.step)
        self.optimiser.step()
        self.objective.after_step()
        self.step += 1
        return logs

    def run(
        self,
        run: RunFolder,
        steps: int,
        title: str,
        labels: dict[str, str],
        measures: Callable[[], dict[str, float]] = dict,
        also_at: int | None = None,
    ) -> None:
        """Train up to `steps`, from the newest checkpoint if there is one.

        Args:
            run: where checkpoints and metrics go.
            steps: the last step.
            title: of the progress line.
            labels: what names the run where it is tracked.
            measures: numbers that a row of metrics has beside the means of the objective's scalars.
            also_at: a step after which a row of metrics is written, too.
        """
        with training(run, self, title, steps, labels=labels) as loop:
            for step in loop:
                loop.add(self.update())
                if loop.due(self.config.log_every) or step == also_at:
                    loop.log("loss", **measures())
            loop.require_finite(self.objective)

    def state(self) -> dict[str, Any]:
        """Everything needed to resume to the bit."""
        return {
            "step": self.step,
            "objective": self.objective.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "batches": self.batches.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.step = state["step"]
        self.objective.load_state_dict(state["objective"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.batches.load_state_dict(state["batches"])
