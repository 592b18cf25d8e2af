"""Make the tables of the pages in results/navigation from the rows there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.text import table_lines
from vd4rl_pomdp.envs.mazes import PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_and_error
from vd4rl_pomdp.runs.files import groups
from vd4rl_pomdp.runs.results import RUNS, read_results
from vd4rl_pomdp.studies.navigation.runs import (
    OBJECTIVES,
    UNTRAINED,
    Condition,
    Measure,
    NavigationRun,
    Numbers,
    load_runs,
    numbers_of,
    online_error,
    paper_number,
    refitted_error,
)

RESULTS = Path(__file__).parents[1] / "results" / "navigation"
REFITTED = [refitted_error(component) for component in ("state", "position", "velocity")]
"""Errors in percent, on held-out trajectories."""
PAPERS_WAY = [online_error(component).raw() for component in ("state", "position", "velocity")]
"""Errors with the paper's protocol and units."""
REFERENCES = {
    UNTRAINED: "untrained",
    "supervised+a": "`supervised+a`",
    "supervised": "`supervised`",
    "supervised_picture": "`supervised_picture`",
}
"""Names of the reference methods on the pages."""
SMALLEST = (*REFERENCES, "no_history", "mik+a", "ah+a")
"""Methods trained with the smallest budget."""
HARD = ("hard_no_curtain", "hard_one_curtain", "hard_three_curtains", "hard_first_person")
STARS, COMPASS = "first_person", "compass_first_person"
PICTURES = {"rgb50": "colour, 50x50", "rgb100": "colour, 100x100"}
"""Names of observation formats other than the preset's on the pages."""
TRAINING_LOSS = Measure("action_loss", "training", "")
"""The action loss of the paper's tables."""
ORDER = ("mik+a", "fj+a", "ah", "mik", "fj", "ah+a", "no_history")


def main_runs() -> list[NavigationRun]:
    """Runs of results/navigation itself, without subfolders."""
    return load_runs(read_results(RESULTS))


def numbers_in(folder: str = ".") -> Numbers:
    """Numbers of the runs of results/navigation, or of a subfolder; empty if it has no runs."""
    place = RESULTS / folder
    return numbers_of(load_runs(read_results(place))) if (place / RUNS).exists() else {}


def values(numbers: Numbers, condition: Condition, measure: Measure) -> list[float]:
    """One number per seed, in order."""
    return list(numbers.get((condition, measure), {}).values())


def _mean(numbers: Numbers, condition: Condition, measure: Measure) -> str:
    """Mean and standard error over seeds; a dash if there are none."""
    found = values(numbers, condition, measure)
    return mean_and_error(found, 1) if found else "–"


def _cell(numbers: Numbers, condition: Condition, measure: Measure) -> str:
    """Mean and standard error over seeds, and the paper's number; a dash if there are none."""
    paper = paper_number(condition, measure) if values(numbers, condition, measure) else None
    return _mean(numbers, condition, measure) + ("" if paper is None else f" ({paper:.1f})")


def _called(method: str) -> str:
    """Name of a method on the pages."""
    return REFERENCES.get(method, f"`{method}`")


def _place_and_speed(numbers: Numbers, condition: Condition) -> str:
    """Position and velocity errors of the refitted probe, in percent; a dash if there are none."""
    return ", ".join(_mean(numbers, condition, error) for error in REFITTED[1:]).replace("–, –", "–")


def maze_lines(numbers: Numbers, maze: str) -> Iterator[str]:
    """All methods at K = 15 in one maze by increasing state error, then the references."""
    rows = []
    ranked = sorted(OBJECTIVES, key=lambda name: np.mean(values(numbers, Condition(maze, name), PAPERS_WAY[0])))
    for method in (*ranked, *REFERENCES):
        condition = Condition(maze, method)
        cells = [_cell(numbers, condition, one) for one in PAPERS_WAY]
        cells.append(", ".join(_mean(numbers, condition, one) for one in REFITTED))
        rows.append((_called(method), len(values(numbers, condition, REFITTED[0])), *cells))
    return table_lines(("", "seeds", "state", "position", "velocity", "state, position, velocity in %"), rows)


def state_lines(numbers: Numbers, settings: Iterable[tuple[str, Condition]]) -> Iterator[str]:
    """State errors of all objectives in the paper's mazes, with its protocol and units, and refitted in percent.

    `settings` are names and conditions, of which maze and method are ignored; only mazes in which every objective was
    trained at K = 15 count.
    """

    def known(maze: str) -> bool:
        return all(values(numbers, Condition(maze, name), PAPERS_WAY[0]) for name in OBJECTIVES)

    rows = []
    for words, setting in settings:
        for maze in filter(known, PAPER_MAZES):
            conditions = [setting._replace(maze=maze, method=name) for name in ORDER]
            for name, measure in ((words, PAPERS_WAY[0]), (f"{words}, in %", REFITTED[0])):
                counts = {len(values(numbers, condition, measure)) for condition in conditions} - {0}
                if counts:
                    seeds = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
                    cells = (_cell(numbers, condition, measure) for condition in conditions)
                    rows.append((f"{maze.replace('_', ' ')}, {name}", seeds, *cells))
    return table_lines(("", "seeds", *(f"`{name}`" for name in ORDER)), rows)


def budget_lines(usual: Numbers, longer: Numbers) -> Iterator[str]:
    """State errors and action losses with three curtains after 2,500 and after 20,000 steps."""
    rows = []
    for method, k in (("ah+a", 15), ("ah+a", 1), ("mik+a", 15), ("mik+a", 1), ("ah", 15)):
        condition = Condition("three_curtains", method, k)
        seeds = ", ".join(str(len(values(numbers, condition, PAPERS_WAY[0]))) for numbers in (usual, longer))
        cells = (
            _cell(numbers, condition, one) for one in (PAPERS_WAY[0], TRAINING_LOSS) for numbers in (usual, longer)
        )
        rows.append((f"`{method}`, K = {k}", seeds, *cells))
    columns = (f"{words}, {steps} steps" for words in ("state error", "action loss") for steps in ("2,500", "20,000"))
    return table_lines(("", "seeds", *columns), rows)


def first_person_lines(numbers: Numbers) -> Iterator[str]:
    """Errors of everything trained under the compass, by increasing state error."""
    conditions = {
        f"`{name}`{words}": Condition(COMPASS, name, self_prediction=bool(words))
        for name in OBJECTIVES
        for words in ("", " with self-prediction")
    } | {words: Condition(COMPASS, name) for name, words in REFERENCES.items()}
    state = {name: values(numbers, condition, REFITTED[0]) for name, condition in conditions.items()}
    parts = (REFITTED, [one._replace(probe="online") for one in REFITTED[1:]])
    rows = []
    for name in sorted(filter(state.get, conditions), key=lambda one: np.mean(state[one])):
        cells = (", ".join(_cell(numbers, conditions[name], one) for one in part) for part in parts)
        rows.append((name, len(state[name]), *cells))
    return table_lines(("", "seeds", "state, position, velocity", "probe beside the model: position, velocity"), rows)


def place_lines(numbers: Numbers, mazes: Sequence[str], methods: Iterable[str]) -> Iterator[str]:
    """Errors of position and velocity at K = 15 by method and maze; a dash for a maze without a run."""
    rows = ((_called(one), *(_place_and_speed(numbers, Condition(maze, one)) for maze in mazes)) for one in methods)
    known = (row for row in rows if any(cell != "–" for cell in row[1:]))
    return table_lines(("", *(f"`{maze}`" for maze in mazes)), known)


def picture_lines(usual: Numbers) -> Iterator[str]:
    """Errors of position and velocity under the stars, for the preset and then by changed setting.

    Each changed setting has one seed; `usual` are numbers of the preset.
    """
    methods = ("supervised_picture", "supervised", "mik+a")
    configs = [(result.record["config"], result) for result in read_results(RESULTS / "first_person" / "pictures")]
    changed = groups(configs, lambda one: PICTURES.get(one[0]["picture"]) or f"rate {one[0]['learning_rate']:g}")
    settings = {"the preset: grey, 50x50, rate 0.002": usual}
    settings |= {words: numbers_of(load_runs(run for _, run in runs)) for words, runs in changed.items()}
    rows = (
        (words, *(_place_and_speed(numbers, Condition(STARS, name)) for name in methods))
        for words, numbers in settings.items()
    )
    return table_lines(("", *map(_called, methods)), rows)
