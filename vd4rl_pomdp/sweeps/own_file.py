"""Sweeps with user plug-ins: jobs are started through the same Python file that registers the plug-ins."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import BY_CALL, REGISTRIES, code_of

JOB_VARIABLE = "VD4RL_POMDP_JOB"
"""Set in the environment of a job's process: a second signal does not kill it early, and it may not start a sweep."""


def own_program() -> list[str]:
    """Arguments of `python` that started this process, if a user's file registered plug-ins; else empty."""
    main = sys.modules["__main__"]
    if not any(registry.has_added for registry in REGISTRIES.values()):
        return []
    if (spec := getattr(main, "__spec__", None)) is not None:
        return ["-m", spec.name.removesuffix(".__main__")]
    return [sys.argv[0]] if getattr(main, "__file__", None) else []


def in_words(program: list[str]) -> str:
    """The command to type instead of `vd4rl-pomdp`, e.g. "python my_method.py"."""
    return shlex.join(["python", *program]) if program else "vd4rl-pomdp"


def program_here() -> str:
    """The command to type instead of `vd4rl-pomdp` to get this process's plug-ins."""
    return in_words(own_program())


def refuse_unknown_to_jobs(settings: Mapping[str, str]) -> None:
    """Raise UserError if settings name a plug-in that a job's process could not import."""
    if not own_program():
        for part, origin in code_of(settings)["plugins"].items():
            if origin == BY_CALL:
                raise UserError(
                    f"{part}: is registered only in this process, but each job is a process of its own: register it in "
                    "a file that ends in `main()`, and start the sweep with `python FILE sweep run`"
                )
