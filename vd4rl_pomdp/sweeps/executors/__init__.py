"""Where the jobs of a sweep run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.options import Options
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions
from vd4rl_pomdp.sweeps.work import Executor


@dataclass(frozen=True)
class Kind:
    """One kind of executor."""

    options: type[Options]
    build: Callable[[Any], Executor]
    """Makes it from its options."""


EXECUTORS = {"local": Kind(LocalOptions, LocalExecutor)}


def executor_kind(name: str) -> Kind:
    """The kind called `name`; raises UserError listing the choices."""
    if name not in EXECUTORS:
        raise UserError(f"unknown executor {name!r}: choose one of {', '.join(EXECUTORS)}")
    return EXECUTORS[name]
