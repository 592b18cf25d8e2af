"""An objective and a state probe, trained together on one maze by the trainer of all stages."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from pretrain.build import build_objective, build_target
from pretrain.train import Trainer
from vd4rl_pomdp.core.seeding import seed_networks
from vd4rl_pomdp.core.streams import random_stream
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.objective import InverseObjective, Objective
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.data import MazeData
from vd4rl_pomdp.studies.navigation.measures import SUPERVISED
from vd4rl_pomdp.studies.navigation.pictures import SHAPES
from vd4rl_pomdp.studies.navigation.probe import ErrorSums, StateProbe

_SUPERVISED_RATE = 0.5
"""Share of the learning rate that supervised references take: at the whole one, two of three seeds predict the mean."""
STAGE = "navigation"


class ProbedObjective(Objective):
    """An objective beside a probe that takes no part in its gradient; the probe's error alone trains a reference."""

    def __init__(self, data: MazeData, config: NavigationConfig) -> None:
        """On the CPU, as is `data`."""
        super().__init__()
        trained = config.trained()
        target = build_target(trained, data.training_actions.numpy())
        objective = build_objective(trained, data.training_actions.shape[1], target, observation=SHAPES[config.picture])
        assert isinstance(objective, InverseObjective)
        self.objective, self.probe, self.errors = objective, StateProbe(objective.encoder.dim), ErrorSums()
        self.data, self.config = data, config

    @property
    def encoder(self) -> Encoder:  # type: ignore[override]
        """The objective's."""
        return self.objective.encoder

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return next(self.parameters()).device

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Objective's and probe's loss of one batch; its errors count until `take_errors`."""
        loss, logs, states = self.measured(window, progress)
        with torch.autocast(self.device.type, enabled=False):
            self.errors.add(*states, self.config.burn_in)
        return loss, logs

    def measured(
        self, window: Windows, progress: float | Tensor
    ) -> tuple[Tensor, dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """The loss of one batch, whose frames are encoded once, with its estimated and true states and which of them
        were hidden."""
        past, future = self.objective.representations(window)
        rows = self.data.dataset.rows(window.key)
        supervised = self.config.method in SUPERVISED
        estimate, truth = self.probe(past, frozen=not supervised), self.data.states.values[rows]
        error = (estimate.float() - truth).square().mean()
        states = (estimate, truth, self.data.states.hidden[rows])
        if supervised:
            return error, {"loss": error.detach()}, states
        loss, logs = self.objective.loss_of(past, future, window, progress)
        return loss + error, logs | {"probe_loss": error.detach()}, states

    def after_step(self) -> None:
        """The objective's."""
        self.objective.after_step()

    def take_errors(self) -> dict[str, float]:
        """Mean errors since the last call."""
        found = self.errors.both(self.data.states.std)
        self.errors.reset()
        return found


class MazeBatches:
    """Uniform training windows of a maze's set."""

    def __init__(self, data: MazeData, config: NavigationConfig) -> None:
        self._data, self._batch_size = data, config.batch_size
        self.draws = random_stream(config.seed, STAGE, "batches", device=data.dataset.t.device)

    def sample(self) -> Windows:
        """The next batch."""
        return self._data.windows(self.draws.integers(self._data.training, self._batch_size))

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume with the same batches."""
        return {"generator": self.draws.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.draws.set_state(state["generator"])


def make_trainer(data: MazeData, config: NavigationConfig, device: torch.device) -> tuple[Trainer, ProbedObjective]:
    """The training of a config on a maze's data, which is moved to the device, and what it trains."""
    seed_networks(config.seed, STAGE)
    probed = ProbedObjective(data, config).to(device)
    return Trainer(probed, MazeBatches(data.on(device), config), config, partial(learning_rate, config)), probed


def learning_rate(config: NavigationConfig, step: int) -> float:
    """Adam's learning rate of a step, the first being 0."""
    rising = min(1.0, (step + 1) / config.warm_up) if config.warm_up else 1.0
    share = max(0, step - config.warm_up) / max(1, config.steps - config.warm_up)
    falling = (1 + math.cos(math.pi * share)) / 2 if config.schedule == "cosine" else 1.0
    share_taken = _SUPERVISED_RATE if config.method in SUPERVISED else 1.0
    return config.learning_rate * rising * falling * share_taken
