"""What a page says of its runs beside numbers: how they were made, how far they are, and where they differ."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.report.grouping import groups
from vd4rl_pomdp.report.load import LoadedRun, compare
from vd4rl_pomdp.report.tables import label, setting

_SEEDS = 12
"""Seeds that are named one by one, at most."""


def title(run: LoadedRun) -> str:
    """A run's stage, method and setting, all but its seed."""
    return f"{run.stage} {label(run.named)}, {setting(run.labels)}"


def unfinished(runs: list[LoadedRun]) -> list[tuple[str, str, str]]:
    """Title, folder and state of every run that is unfinished or diverged."""
    return [
        (f"{title(run)}, seed {run.labels['seed']}", str(run.path), _state(run)) for run in runs if not run.finished
    ]


def _state(run: LoadedRun) -> str:
    """How far it is, and why no further."""
    message = (run.result.diverged or {}).get("message")
    return f"{run.progress}: {message}" if message else run.progress


def differing(runs: list[LoadedRun]) -> list[tuple[str, str]]:
    """Each method of which there are several variants, and all settings that differ, those of a preset included.

    Each set with settings of its own comes first.
    """
    told = zip(runs, compare(runs, brief=False), strict=True)
    named = {
        label(run.named): ", ".join(filter(None, parts))
        for run, parts in told
        if run.stage == "finetune" and run.variant
    }
    return [*_own_to_sets(runs).items(), *named.items()]


def _own_to_sets(runs: list[LoadedRun]) -> dict[str, str]:
    """Settings that go by the set, in words."""
    words: dict[str, dict[str, None]] = {}
    for run in runs:
        told = (f"{name} {value}" for name, value in run.of_set.items() if run.stage == "finetune")
        words.setdefault(run.set_name, {}).update(dict.fromkeys(told))
    return {place: ", ".join(texts) for place, texts in words.items() if texts}


def unlike(runs: list[LoadedRun]) -> list[str]:
    """What stands side by side and was not made of the same, in sentences: contents of a set, code of a part."""
    policies = [run for run in runs if run.stage == "finetune" and run.rows]
    contents = [(f"the set of {run.set_name}", _content(run), run) for run in policies if _content(run)]
    codes = [(part, code, run) for run in policies for part, code in _code(run).items()]
    return [*_unlike(contents, "contents"), *_unlike(codes, "states of its code")]


def _unlike(told: list[tuple[str, str, LoadedRun]], noun: str) -> Iterator[str]:
    """A sentence for each subject of which runs tell different things.

    Args:
        told: subjects, what is told of them, and by which runs.
        noun: what such things are called.
    """
    for subject, members in groups(told, lambda one: one[0]).items():
        by_value = groups(members, lambda one: one[1])
        if len(by_value) > 1:
            methods = (sorted({label(run.named) for *_, run in some}) for some in by_value.values())
            words = (f"{value} ({', '.join(some)})" for value, some in zip(by_value, methods, strict=True))
            yield f"{subject} has {len(by_value)} {noun}: {'; '.join(words)}"


def _content(run: LoadedRun) -> str:
    return run.record.get("inputs", {}).get("data", "")[:12]


def _code(run: LoadedRun) -> dict[str, str]:
    """Package and file of each part that is not this project's: of a pretraining's, then of a policy's if it is other.

    Of a method those of the pretraining, where they are recorded: nothing of it is used afterwards.
    """
    before, own = _parts_of(run.result.origin), _parts_of(run.record)
    after = {part: told for part, told in own.items() if not (part in before and part.startswith("method "))}
    told = {part: [one[part] for one in (before, after) if part in one] for part in before | after}
    return {part: " then ".join(dict.fromkeys(states)) for part, states in told.items()}


def _parts_of(record: Mapping[str, Any]) -> dict[str, str]:
    """Package and file of each part that a record tells of."""
    told = [record.get(name, {}) for name in ("plugins", "sources")]
    names = dict.fromkeys(name for one in told for name in one)
    return {name: ", ".join(filter(None, (one.get(name) for one in told))) for name in names}


def facts(runs: list[LoadedRun]) -> list[dict[str, str]]:
    """One entry for all seeds of a condition: what they share, and what they were computed with."""
    return [_facts(name, members) for name, members in groups(runs, title).items()]


def _facts(name: str, runs: list[LoadedRun]) -> dict[str, str]:
    seeds = sorted({str(run.labels["seed"]) for run in runs}, key=lambda seed: (len(seed), seed))
    shown = seeds if len(seeds) <= _SEEDS else [*seeds[:3], "...", seeds[-1]]
    seconds = [run.seconds for run in runs if run.seconds is not None]
    first = runs[0].record
    return {
        "title": f"{name}, {'seeds' if len(seeds) > 1 else 'seed'} {', '.join(shown)}",
        "commits": commits(runs),
        "machines": machines(runs),
        "time": f"{min(seconds):.0f} to {max(seconds):.0f} s" if seconds else runs[0].progress,
        "command": first.get("command", ""),
        "config": json.dumps({"config": settings_of(first["config"]), "versions": first.get("versions")}, indent=1),
    }


def commits(runs: list[LoadedRun]) -> str:
    """The commits that runs were made with, in words."""
    return ", ".join(dict.fromkeys(run.result.commit or "unknown" for run in runs))


def machines(runs: list[LoadedRun]) -> str:
    """The machines that runs were made on, in words."""
    return "; ".join(dict.fromkeys(run.result.machine or "not recorded" for run in runs))
