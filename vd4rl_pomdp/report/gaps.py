"""What a report has no final score for: every method, setting and seed that other runs of it have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

from vd4rl_pomdp.report.load import LABELS, Run

Row = dict[str, Any]
Place = tuple[str, str, str]
"""Task, quality, corruption."""
MISSING = "missing"
CELL = ("task", "quality", "corruption", "algorithm", "method", "variant")


def find_gaps(runs: list[Run]) -> list[Row]:
    """One row for each run that is not there or not finished: CELL, seed and `state`.

    A setting is to have every method, with every variant of it, and each of these every seed that it has of any.
    """
    grid = [run for run in runs if run.stage == "finetune" and run.labels["task"]]
    rows = []
    for place in dict.fromkeys(map(_place, grid)):
        here = [run for run in grid if _place(run) == place]
        for algorithm, method, variant in _expected(grid, place):
            mine = {
                run.labels["seed"]: run
                for run in here
                if (run.labels["algorithm"], run.labels["method"], run.variant) == (algorithm, method, variant)
            }
            cell = dict(zip(CELL, (*place, algorithm, method, variant), strict=True))
            for seed in sorted({run.labels["seed"] for run in here}):
                if seed not in mine or not (mine[seed].finished and mine[seed].rows):
                    rows.append(cell | {"seed": seed, "state": _state(mine.get(seed))})
    return rows


def _place(run: Run) -> Place:
    task, quality, corruption = (run.labels[name] for name in LABELS[:3])
    return task, quality, corruption


def _state(run: Run | None) -> str:
    return MISSING if run is None or run.finished else run.progress


def _expected(grid: list[Run], place: Place) -> Iterator[tuple[str, str, str]]:
    """Algorithm, method and variant of every run that a setting is to have.

    What differs between fields of a corruption is asked for wherever that corruption is, other data nowhere else.
    """
    for algorithm, method in dict.fromkeys(map(_method, grid)):
        mine = [run for run in grid if _method(run) == (algorithm, method)]
        for shared in _shared(mine, place):
            alike = [run for run in mine if run.parts[0] == shared and run.labels["corruption"] == place[2]]
            for fields in {run.parts[1]: None for run in alike} or [""]:
                here = [run for run in alike if run.parts[1] == fields and _place(run) == place]
                for data in {run.parts[2]: None for run in here} or [""]:
                    yield algorithm, method, ", ".join(filter(None, (shared, fields, data)))


def _shared(mine: list[Run], place: Place) -> Iterable[str]:
    """Variants of a method that a setting is to have: those of every setting that has one in common with it.

    Settings of which each has its own, such as a budget for every task, ask for nothing of one another.
    """
    by_place: dict[Place, dict[str, None]] = {}
    for run in mine:
        by_place.setdefault(_place(run), {})[run.parts[0]] = None
    own = by_place.get(place)
    wanted = [there for there in by_place.values() if own is None or own.keys() & there.keys()]
    return {variant: None for there in wanted for variant in there}


def _method(run: Run) -> tuple[str, str]:
    return run.labels["algorithm"], run.labels["method"]


def in_words(gaps: list[Row]) -> str:
    """Gaps of one cell: "seeds 1, 2 missing; seed 3 unfinished at 20 of 40 updates"."""
    sentences = []
    for state, members in groupby(sorted(gaps, key=lambda row: row["state"]), lambda row: row["state"]):
        seeds = [str(row["seed"]) for row in members]
        sentences.append(f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)} {state}")
    return "; ".join(sentences)


def cell(row: Row) -> tuple[str, ...]:
    """The cell that a row of a table or of `find_gaps` is about."""
    return tuple(str(row[name]) for name in CELL)
