"""References that are told the true state in training: what a memory could give, were its objective perfect.

supervised          the encoder of mik, a GRU over the past observations
supervised+a        the encoder of mik+a, which reads past actions, too
supervised_picture  no memory: the encoder of acro
integrator          a GRU of the first observation, the actions since and the time: what adding up actions could give

A head regresses the simulator's pose and velocity at row t from s_t, which the encoder computes from corrupted pixels
as ever; the encoder never sees a state itself, and is then frozen like every other. The integrator trains on histories
up to their episode's end: what it adds up over an episode it could not learn from windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.types import StateWindows, Windows
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.nn.objective import Objective


@dataclass(frozen=True)
class SupervisedOptions(Options):
    """Options of the supervised references."""

    head_dim: int = 256
    """Units of the regression head's two hidden layers."""

    hold_out: bool = False
    """Leave out the episodes that a probe is tested on, every fifth, whose states no loss is then told."""

    limits: ClassVar[Limits] = {"head_dim": 1}


class Supervised(Objective):
    """Regresses the state of row t, standardised over the training set, on s_t; constant coordinates are left out."""

    columns: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, encoder: Encoder, target: StateScale, options: SupervisedOptions, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        columns = torch.nonzero(target.std)[:, 0]  # the others cannot be standardised, and tell nothing
        if not len(columns):
            raise UserError("the simulator's states in this set are all the same: there is nothing to regress")
        self.register_buffer("columns", columns)
        self.register_buffer("mean", target.mean[columns].float())
        self.register_buffer("std", target.std[columns].float())
        self.pose = int((columns < target.pose).sum())
        """Coordinates among them that are pose; they come first."""
        self.head = mlp(encoder.dim, options.head_dim, len(columns))

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error over coordinates and real rows whose state is told; `pose_loss` is that of poses alone."""
        assert isinstance(window, StateWindows), "windows without states train no supervised reference"
        truth = (window.state[..., self.columns] - self.mean) / self.std
        told = window.real & ~truth.isnan().any(-1)
        truth = truth.nan_to_num()  # before the loss: NaN times zero would be NaN
        errors = (self.head(self.encoder.encode(window)).to(truth) - truth).square()
        real = told.to(errors)[..., None]
        error = (errors * real).sum((0, 1)) / real.sum().clamp(min=1)  # a batch may be of held-out episodes alone
        loss, parts = error.mean(), {"pose_loss": error[: self.pose], "velocity_loss": error[self.pose :]}
        return loss, {"loss": loss.detach()} | {name: e.mean().detach() for name, e in parts.items() if len(e)}
