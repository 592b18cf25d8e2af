"""All fine-tuning algorithms by name."""

from __future__ import annotations

from finetune.algorithms.algorithm import Algorithm, Loss, ReturnOptions
from finetune.algorithms.bc import BC
from finetune.algorithms.drqv2_bc import DrQv2BC
from finetune.algorithms.fql import FQL
from finetune.algorithms.iql import IQL
from finetune.algorithms.rebrac import ReBRAC
from finetune.algorithms.td3_bc import TD3BC
from vd4rl_pomdp.core.options import refuse_options
from vd4rl_pomdp.core.registry import Registry

__all__ = ["ALGORITHMS", "BC", "TD3BC", "Algorithm", "Loss", "ReturnOptions"]

ALGORITHMS: Registry[type[Algorithm]] = Registry(
    "algorithm",
    {"td3_bc": TD3BC, "rebrac": ReBRAC, "drqv2_bc": DrQv2BC, "iql": IQL, "fql": FQL, "bc": BC},
    lambda part: isinstance(part, type) and issubclass(part, Algorithm),
    "a class of finetune.algorithms.Algorithm",
    lambda name, part: refuse_options(part.options),
)
"""All algorithms. Packages add theirs as classes through the entry-point group `vd4rl_pomdp.algorithms`."""
