"""Every fine-tuning algorithm by name."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from finetune.algorithms.bc import BC
from finetune.algorithms.drqv2_bc import DrQv2BC
from finetune.algorithms.td3_bc import TD3BC
from finetune.features import FeatureBatch
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.policy import Policy


class Algorithm(Protocol):
    """Trains a policy on batches of frozen representations."""

    policy: Policy
    options: tuple[str, ...]
    """Which of `OPTIONS` it reads; the others are refused."""

    def update(self, batch: FeatureBatch) -> dict[str, Tensor]:
        """One update; returns detached scalars."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on, targets and optimisers included."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""


OPTIONS = frozenset(("alpha", "gamma", "n_step"))
"""Settings that not every algorithm reads."""
ALGORITHMS = {"td3_bc": TD3BC, "drqv2_bc": DrQv2BC, "bc": BC}


def get_algorithm(name: str) -> type[TD3BC] | type[BC]:
    """The algorithm called `name`; raises UserError listing the choices."""
    if name not in ALGORITHMS:
        raise UserError(f"unknown algorithm {name!r}: choose one of {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]  # type: ignore[return-value]
