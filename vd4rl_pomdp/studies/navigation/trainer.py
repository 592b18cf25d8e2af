"""An objective and a state probe, trained together on one maze; resumable to the bit on a CPU."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pretrain.build import build_objective, build_target
from vd4rl_pomdp.core.seeding import stream_generator
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.objective import InverseObjective
from vd4rl_pomdp.runs.device import autocast
from vd4rl_pomdp.runs.loop import training
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.data import MazeData
from vd4rl_pomdp.studies.navigation.methods import SUPERVISED
from vd4rl_pomdp.studies.navigation.observations import SHAPES
from vd4rl_pomdp.studies.navigation.probe import ErrorSums, StateProbe

_SUPERVISED_RATE = 0.5
"""Share of the learning rate that supervised references take: at the whole one, two of three seeds predict the mean."""
STAGE = "navigation"


def make_objective(data: MazeData, config: NavigationConfig) -> InverseObjective:
    """The objective of a config on a maze's data, on the CPU."""
    trained = config.trained()
    target = build_target(trained, data.training_actions.numpy())
    objective = build_objective(trained, data.training_actions.shape[1], target, observation=SHAPES[config.picture])
    assert isinstance(objective, InverseObjective)
    return objective


class NavigationTrainer:
    """One objective and its probe on one maze's data."""

    def __init__(self, objective: InverseObjective, data: MazeData, config: NavigationConfig) -> None:
        self.objective, self.data, self.config = objective, data, config
        self.device = next(objective.parameters()).device
        self.probe = StateProbe(objective.encoder.dim).to(self.device)
        self.generator = stream_generator(config.seed, STAGE, "batches")
        parameters = [*objective.parameters(), *self.probe.parameters()]
        self.optimiser = torch.optim.Adam(parameters, lr=config.learning_rate)
        self.step = 0
        self.errors = ErrorSums()
        """Since the last row of metrics."""

    def batch(self) -> Windows:
        """The next training windows."""
        number = torch.randint(self.data.training, (self.config.batch_size,), generator=self.generator)
        return self.data.windows(number)

    def update(self) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """One gradient step; returns scalars, and (estimated, true, hidden) states."""
        window = self.batch()
        with autocast(self.device, self.config.precision):
            loss, logs, states = self.losses(window)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.config, self.step)
        self.optimiser.step()
        self.objective.after_step()
        self.step += 1
        return logs, states

    def losses(self, window: Windows) -> tuple[Tensor, dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """Objective's and probe's loss of one batch, whose frames are encoded once."""
        past, future = self.objective.representations(window)
        rows = self.data.dataset.rows(window.key)
        supervised = self.config.method in SUPERVISED
        estimate, truth = self.probe(past, frozen=not supervised), self.data.states.values[rows]
        error = (estimate.float() - truth).square().mean()
        states = (estimate, truth, self.data.states.hidden[rows])
        if supervised:
            return error, {"loss": error.detach()}, states
        loss, logs = self.objective.loss_of(past, future, window, self.step / max(1, self.config.steps))
        return loss + error, logs | {"probe_loss": error.detach()}, states

    def run(self, run: RunFolder, steps: int) -> None:
        """Train up to `steps`, from the newest checkpoint if there is one."""
        labels = {"method": self.config.method, "task": self.data.maze.name}
        with training(run, self, f"{self.data.maze.name} {self.config.method}", steps, labels=labels) as loop:
            for step in loop:
                logs, states = self.update()
                loop.add(logs)
                self.errors.add(*states, self.config.burn_in)
                if loop.due(self.config.log_every) or step == steps - self.config.average_last:
                    loop.log("loss", "state", **self.errors.both(self.data.states.std))
                    self.errors = ErrorSums()
            loop.require_finite(self.objective)

    def state(self) -> dict[str, Any]:
        """Everything needed to go on to the bit, also between two rows of metrics."""
        return {
            "step": self.step,
            "errors": self.errors.state(),
            "objective": self.objective.state_dict(),
            "probe": self.probe.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "batches": self.generator.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.step = state["step"]
        self.errors.restore(state["errors"])
        self.objective.load_state_dict(state["objective"])
        self.probe.load_state_dict(state["probe"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["batches"])


def learning_rate(config: NavigationConfig, step: int) -> float:
    """Adam's learning rate of a step, the first being 0."""
    rising = min(1.0, (step + 1) / config.warm_up) if config.warm_up else 1.0
    share = max(0, step - config.warm_up) / max(1, config.steps - config.warm_up)
    falling = (1 + math.cos(math.pi * share)) / 2 if config.schedule == "cosine" else 1.0
    share_taken = _SUPERVISED_RATE if config.method in SUPERVISED else 1.0
    return config.learning_rate * rising * falling * share_taken
