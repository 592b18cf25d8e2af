"""Every fine-tuning algorithm by name."""

from __future__ import annotations

from finetune.algorithms.algorithm import Algorithm, Loss
from finetune.algorithms.bc import BC
from finetune.algorithms.drqv2_bc import DrQv2BC
from finetune.algorithms.iql import IQL
from finetune.algorithms.td3_bc import TD3BC
from vd4rl_pomdp.errors import UserError

__all__ = ["ALGORITHMS", "BC", "IQL", "OPTIONS", "TD3BC", "Algorithm", "DrQv2BC", "Loss", "get_algorithm"]

OPTIONS = frozenset(("alpha", "expectile", "gamma", "n_step", "temperature"))
"""Settings that not every algorithm reads."""
ALGORITHMS = {"td3_bc": TD3BC, "drqv2_bc": DrQv2BC, "iql": IQL, "bc": BC}


def get_algorithm(name: str) -> type[TD3BC] | type[IQL] | type[BC]:
    """The algorithm called `name`; raises UserError listing the choices."""
    if name not in ALGORITHMS:
        raise UserError(f"unknown algorithm {name!r}: choose one of {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]  # type: ignore[return-value]
