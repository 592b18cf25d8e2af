"""Where the jobs of a sweep run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import refuse_unknown
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.sweeps.executors.local import LocalOptions
from vd4rl_pomdp.sweeps.executors.ray import RayCluster, RayOptions
from vd4rl_pomdp.sweeps.executors.slurm import SlurmCluster, SlurmOptions
from vd4rl_pomdp.sweeps.work import Cluster

EXECUTORS: dict[str, type[Options]] = {"local": LocalOptions, "slurm": SlurmOptions, "ray": RayOptions}
"""Options by name."""
CLUSTERS: dict[str, Callable[[Any, Path], Cluster]] = {"slurm": SlurmCluster, "ray": RayCluster}
"""Makes a cluster from its options, and a folder for what its tasks print."""


def executor_options(name: str) -> type[Options]:
    """Options of the executor called `name`; raises UserError listing the choices."""
    refuse_unknown("executor", name, EXECUTORS)
    return EXECUTORS[name]
