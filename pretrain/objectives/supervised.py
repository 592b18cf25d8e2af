"""References trained to regress the true simulator state: an upper bound on what a memory could learn.

supervised          mik's encoder: a GRU over past observations
supervised+a        mik+a's encoder, which also reads past actions
supervised_picture  acro's encoder, without memory
integrator          a GRU of the first observation, the actions since and the time: what dead reckoning could give

A head regresses the simulator's pose and velocity at row t from s_t. The encoder reads corrupted pixels as usual, never
the state, and is frozen afterwards like every other. The integrator trains on histories up to the episode's end, since
windows are too short to learn to add up actions over a whole episode.
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
    """Units in each of the regression head's two hidden layers."""

    hold_out: bool = False
    """Exclude the states of the probe's test episodes (every fifth) from the loss."""

    limits: ClassVar[Limits] = {"head_dim": 1}


class Supervised(Objective):
    """Regress the state at row t, standardised over the training set, from s_t; constant coordinates are left out."""

    columns: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, encoder: Encoder, target: StateScale, options: SupervisedOptions, seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        columns = torch.nonzero(target.std)[:, 0]  # constant coordinates cannot be standardised
        if not len(columns):
            raise UserError(
                "all simulator states in this dataset are equal, so there is nothing to regress: choose another dataset"
            )
        self.register_buffer("columns", columns)
        self.register_buffer("mean", target.mean[columns].float())
        self.register_buffer("std", target.std[columns].float())
        self.pose = int((columns < target.pose).sum())
        """Number of pose coordinates among `columns`; they come first."""
        self.head = mlp(encoder.dim, options.head_dim, len(columns))

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """MSE over coordinates and real rows with a known state; `pose_loss` and `velocity_loss` are its two parts."""
        assert isinstance(window, StateWindows), "windows without states train no supervised reference"
        truth = (window.state[..., self.columns] - self.mean) / self.std
        known = window.real & ~truth.isnan().any(-1)
        truth = truth.nan_to_num()  # before the loss: NaN times zero would be NaN
        errors = (self.head(self.encoder.encode(window)).to(truth) - truth).square()
        real = known.to(errors)[..., None]
        error = (errors * real).sum((0, 1)) / real.sum().clamp(min=1)  # all episodes of a batch may be held out
        loss, parts = error.mean(), {"pose_loss": error[: self.pose], "velocity_loss": error[self.pose :]}
        return loss, {"loss": loss.detach()} | {name: e.mean().detach() for name, e in parts.items() if len(e)}
