"""Parts of one's own in a sweep: processes of its jobs import the file that it was started from, as `multiprocessing`
has its processes do: everything but what stands below `if __name__ == "__main__":`.
"""

from __future__ import annotations

import multiprocessing.spawn
import os
import shlex
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import BY_CALL, REGISTRIES, origins

if TYPE_CHECKING:
    from vd4rl_pomdp.sweeps.plan import Job

OwnFile = dict[str, str]
"""A main module by `multiprocessing`'s name for how it is found: a path, or a module's name; empty for none."""
_PROGRAM = "vd4rl-pomdp"
_PATH, _NAME = "init_main_from_path", "init_main_from_name"


class _Loading:
    """Whether a job's process is at importing its file."""

    now = False


def own_file() -> OwnFile:
    """What this process was started from, if it has added parts and is not the program itself."""
    if not any(registry.has_added for registry in REGISTRIES.values()):
        return {}
    told = multiprocessing.spawn.get_preparation_data("")
    found = {how: told[how] for how in (_PATH, _NAME) if told.get(how)}
    return {} if Path(found.get(_PATH, "")).stem == _PROGRAM else found


def load(file: OwnFile) -> None:
    """Import a file so that it is this process's main module, and that of the processes it starts in turn."""
    if _PATH in file:
        sys.path.insert(0, str(Path(file[_PATH]).parent))
    elif _NAME in file:  # which `python -m` found from there
        sys.path.insert(0, os.getcwd())
    _Loading.now = True
    try:
        multiprocessing.spawn.prepare(dict(file))
    finally:
        _Loading.now = False
    if file:
        sys.argv[0] = str(sys.modules["__main__"].__file__)


def program_here() -> str:
    """What one types in place of `vd4rl-pomdp` to have the parts that this process has."""
    file = own_file()
    return program_of({_PATH: sys.argv[0]} if _PATH in file else file)


def same_file(one: OwnFile, other: OwnFile) -> bool:
    """Whether two name the same file, by whatever path."""
    paths = [Path(file[_PATH]).resolve() if _PATH in file else None for file in (one, other)]
    return one == other if None in paths else paths[0] == paths[1]


def program_of(file: OwnFile) -> str:
    """What one types in place of `vd4rl-pomdp` to have a file's parts."""
    if _NAME in file:
        return f"python -m {file[_NAME]}"
    return f"python {shlex.quote(file[_PATH])}" if file else _PROGRAM


def refuse_unknown_to_jobs(jobs: Iterable[Job]) -> None:
    """Raise UserError if a job names a part that its process could not know."""
    if not own_file() and (part := next(parts_by_call(jobs), None)):
        raise UserError(
            f"{part}: was registered in this process alone, and jobs have processes of their own: register it "
            "in a file that ends in `main()`, and start the sweep by `python FILE sweep run`"
        )


def parts_by_call(jobs: Iterable[Job]) -> Iterator[str]:
    """The parts that jobs name and that a call has added to this process: "method mine"."""
    for job in jobs:
        yield from (part for part, origin in origins(dict(job.settings)).items() if origin == BY_CALL)


def refuse_while_loading() -> None:
    """Raise UserError where the file starts the sweep anew when a job's process imports it."""
    if _Loading.now:
        raise UserError('a job cannot start a sweep: put the call that did below `if __name__ == "__main__":`')
