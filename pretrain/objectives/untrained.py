"""References that make a table honest; no pretraining step is taken, their encoders are written as initialised.

random   stays as it is: the floor
bc       is trained by fine-tuning, end to end, by behaviour cloning
drq_bc   is trained by fine-tuning, end to end, by the critic's loss (DrQ-v2+BC of V-D4RL)
state    is no network: the simulator state itself, a reference on sets that store it
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.objective import Objective


@dataclass(frozen=True)
class StateOptions(Options):
    """Options of the simulator state in place of an encoder."""

    pose_noise: float = 0.0
    """Normal noise on poses: its mean absolute value in percent of each one's standard deviation, as probes count."""
    velocity_noise: float = 0.0
    """The same on velocities."""

    limits: ClassVar[Limits] = {"pose_noise": (0, 1000), "velocity_noise": (0, 1000)}


class Untrained(Objective):
    """Trains nothing."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: Options, seed: int) -> None:
        super().__init__()
        self.encoder = encoder

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Zero."""
        loss = self.encoder.encode(window).sum() * 0
        return loss, {"loss": loss.detach()}
