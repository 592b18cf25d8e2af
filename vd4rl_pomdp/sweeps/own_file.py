"""Parts of one's own in a sweep: its jobs are started as it was, by the file that registers the parts."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import BY_CALL, REGISTRIES, code_of

JOB_VARIABLE = "VD4RL_POMDP_JOB"
"""Set in the environment of a job's process: a second signal ends it no sooner, and it may start no sweep."""


def own_program() -> list[str]:
    """What stood behind `python` where this process was started from a file that adds parts; empty if it was not."""
    main = sys.modules["__main__"]
    if not any(registry.has_added for registry in REGISTRIES.values()):
        return []
    if (spec := getattr(main, "__spec__", None)) is not None:
        return ["-m", spec.name.removesuffix(".__main__")]
    return [sys.argv[0]] if getattr(main, "__file__", None) else []


def in_words(program: list[str]) -> str:
    """What one types in place of `vd4rl-pomdp`."""
    return shlex.join(["python", *program]) if program else "vd4rl-pomdp"


def program_here() -> str:
    """What one types in place of `vd4rl-pomdp` to have the parts that this process has."""
    return in_words(own_program())


def refuse_unknown_to_jobs(settings: Mapping[str, str]) -> None:
    """Raise UserError if settings name a part that the process of a job could not know."""
    if not own_program():
        for part, origin in code_of(settings)["plugins"].items():
            if origin == BY_CALL:
                raise UserError(
                    f"{part}: was registered in this process alone, and jobs have processes of their own: register it "
                    "in a file that ends in `main()`, and start the sweep by `python FILE sweep run`"
                )
