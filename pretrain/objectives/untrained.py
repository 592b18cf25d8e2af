"""`random`: the encoder as it is initialised, the floor that makes a table honest."""

from __future__ import annotations

from torch import Tensor

from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.objective import InverseConfig, Objective
from vd4rl_pomdp.types import Windows


class Untrained(Objective):
    """Trains nothing."""

    def __init__(self, encoder: Encoder, target: ActionTarget, config: InverseConfig) -> None:
        super().__init__()
        self.encoder = encoder

    def loss(self, window: Windows, progress: float) -> tuple[Tensor, dict[str, Tensor]]:
        """Zero."""
        return self.encoder.encode(window).sum() * 0, {}
