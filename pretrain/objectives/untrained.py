"""References without pretraining: their encoders are saved as initialised.

random   a frozen random encoder: the lower bound
bc       trained end to end during fine-tuning, by behaviour cloning
drq_bc   trained end to end during fine-tuning, by the critic's loss (DrQ-v2+BC of V-D4RL)
state    no network: the simulator state itself, for data sets that store it
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
    """Options of the `state` reference."""

    pose_noise: float = 0.0
    """Gaussian noise on poses: its mean absolute value, in percent of each coordinate's standard deviation.
    This is the unit of probe errors."""
    velocity_noise: float = 0.0
    """The same for velocities."""

    limits: ClassVar[Limits] = {"pose_noise": (0, 1000), "velocity_noise": (0, 1000)}


class Untrained(Objective):
    """Objective without training."""

    def __init__(self, encoder: Encoder, target: ActionTarget, options: Options, seed: int) -> None:
        super().__init__()
        self.encoder = encoder

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        loss = self.encoder.encode(window).sum() * 0
        return loss, {"loss": loss.detach()}
