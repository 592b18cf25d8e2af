"""Which fine-tunings of a plan one process may train together, as `vd4rl-pomdp finetune WORDS + WORDS` does.

Each stays a job of its own: with its own folder, command, attempts and end.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.sweeps.folder import FAILED, KILLED
from vd4rl_pomdp.sweeps.plan import Job

_OWN = ("--seed", "--view-seed", "--encoder", "--data", "--out")
"""Flags in which the runs of a stack may differ."""
STACKED = "finetune"


def kind_of(job: Job) -> tuple[str, ...]:
    """What jobs have in common that stack, as far as it can be told before their encoders are there; () if none may."""
    if job.section != STACKED or job.settings.get("views") == "0":  # then pixels are read, by an encoder a run
        return ()
    words = list(job.words)
    for flag in _OWN:
        if flag in words:
            del words[words.index(flag) : words.index(flag) + 2]
    return *words, *(job.settings.get(name, "") for name in ("task", "algorithm"))  # those that the encoder decides


def width_of(job: Job, made_in: Path) -> int | None:
    """Width of what a fine-tuning is given of its encoder, which is there; None if it names none that can be read.

    Args:
        job: the fine-tuning.
        made_in: which the paths in its command begin at.
    """
    try:
        encoder = read_record(made_in / job.words[job.words.index("--encoder") + 1]).encoder
    except (ValueError, UserError):
        return None
    told = {"readout": job.settings["readout"]} if "readout" in job.settings else {}
    return replace(encoder, **told).dim  # type: ignore[arg-type]


def runs_alone(rows: Iterable[Row]) -> bool:
    """Whether a job is no longer stacked, judging by its attempts: a stack that it was in could not do it."""
    return any("stack" in row and row["cause"] in (FAILED, KILLED) for row in rows)


def in_stacks(
    jobs: Iterable[Job], size: int, attempts: Mapping[str, list[Row]], alike: Callable[[Job], Hashable] = kind_of
) -> list[list[Job]]:
    """Jobs by the process that does them, in their order: stacks of up to `size`, and single ones.

    Args:
        jobs: those to do.
        size: most jobs of a stack.
        attempts: at them, by name.
        alike: equal for jobs that stack; false for one that does not.
    """
    groups: dict[Hashable, list[Job]] = defaultdict(list)
    for job in jobs:
        groups[job.name if runs_alone(attempts.get(job.name, ())) else alike(job) or job.name].append(job)
    return [group[first : first + size] for group in groups.values() for first in range(0, len(group), size)]


def words_of_stack(jobs: list[Job]) -> list[str]:
    """The command that does some jobs, after `vd4rl-pomdp`."""
    words = list(jobs[0].words)
    for job in jobs[1:]:
        words += ["+", *job.words[1:]]
    return words
