"""Where the jobs of a sweep run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import refuse_unknown
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions
from vd4rl_pomdp.sweeps.executors.ray import RayExecutor, RayOptions
from vd4rl_pomdp.sweeps.executors.slurm import SlurmExecutor
from vd4rl_pomdp.sweeps.executors.slurm_queue import SlurmOptions
from vd4rl_pomdp.sweeps.work import Executor


@dataclass(frozen=True)
class Kind:
    """One kind of executor."""

    options: type[Options]
    build: Callable[[Any, Path], Executor]
    """Makes it from its options, and a folder for its own files beside the runs."""


EXECUTORS = {
    "local": Kind(LocalOptions, lambda options, folder: LocalExecutor(options)),
    "slurm": Kind(SlurmOptions, SlurmExecutor),
    "ray": Kind(RayOptions, lambda options, folder: RayExecutor(options)),
}


def executor_kind(name: str) -> Kind:
    """The kind called `name`; raises UserError listing the choices."""
    refuse_unknown("executor", name, EXECUTORS)
    return EXECUTORS[name]
