"""Make the tables of the pages in results/navigation from the rows there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from vd4rl_pomdp.envs.mazes import PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_and_error
from vd4rl_pomdp.runs.results import RUNS, read_results
from vd4rl_pomdp.studies.navigation.measures import (
    OBJECTIVES,
    UNTRAINED,
    Condition,
    Measure,
    online_error,
    paper_number,
    refitted_error,
)
from vd4rl_pomdp.studies.navigation.report import Numbers
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, frame_of, load_runs, numbers_of

RESULTS = Path(__file__).parents[1] / "results" / "navigation"
REFITTED = [refitted_error(component) for component in ("state", "position", "velocity")]
"""Errors in percent, on held-out trajectories."""
PAPERS_WAY = [online_error(component).raw() for component in ("state", "position", "velocity")]
MEASURES = (*PAPERS_WAY, *REFITTED)
"""Columns of a maze's table: the paper's protocol and units, then percent by the refitted probe."""
REFERENCES = {
    UNTRAINED: "untrained",
    "supervised+a": "`supervised+a`",
    "supervised": "`supervised`",
    "supervised_picture": "`supervised_picture`",
}
"""Names of the reference methods on the pages."""
HARD = ("hard_no_curtain", "hard_one_curtain", "hard_three_curtains", "hard_first_person")
STARS, COMPASS = "first_person", "compass_first_person"
PICTURES = {"rgb50": "colour, 50x50", "rgb100": "colour, 100x100"}
"""Names of observation formats other than the preset's on the pages."""
TRAINING_LOSS = Measure("action_loss", "training", "")
"""The action loss of the paper's tables."""
LONGER = "budget"
"""Folder of the runs with 20,000 steps."""
_ORDER = ("mik+a", "fj+a", "ah", "mik", "fj", "ah+a", "no_history")


def main_runs() -> list[NavigationRun]:
    """Runs of results/navigation itself, without subfolders."""
    return load_runs(read_results(RESULTS))


def numbers_in(folder: str = ".") -> Numbers:
    """Numbers of the runs of results/navigation, or of a subfolder; empty if it has no runs."""
    place = RESULTS / folder
    return numbers_of(frame_of(load_runs(read_results(place)))) if (place / RUNS).exists() else {}


def values(numbers: Numbers, condition: Condition, measure: Measure) -> list[float]:
    """One number per seed, in order."""
    return list(numbers.get((*condition, *measure), {}).values())


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


def _head(columns: Sequence[str]) -> Iterator[str]:
    """A table's first two lines; the column of row names has no title."""
    yield f"| | {' | '.join(columns)} |"
    yield "|---|" + "---:|" * len(columns)


def maze_lines(numbers: Numbers, maze: str) -> Iterator[str]:
    """All methods at K = 15 in one maze by increasing state error, then the references."""
    yield from _head(("seeds", "state", "position", "velocity", "state, position, velocity in %"))
    ranked = sorted(OBJECTIVES, key=lambda name: np.mean(values(numbers, Condition(maze, name), MEASURES[0])))
    for method in (*ranked, *REFERENCES):
        condition = Condition(maze, method)
        cells = [_cell(numbers, condition, one) for one in PAPERS_WAY]
        cells.append(", ".join(_mean(numbers, condition, one) for one in REFITTED))
        yield f"| {_called(method)} | {len(values(numbers, condition, REFITTED[0]))} | {' | '.join(cells)} |"


def _measured(numbers: Numbers) -> list[str]:
    """The paper's mazes in which every objective was trained at K = 15."""
    return [
        maze for maze in PAPER_MAZES if all(values(numbers, Condition(maze, name), MEASURES[0]) for name in OBJECTIVES)
    ]


def state_lines(numbers: Numbers, ks: Sequence[int]) -> Iterator[str]:
    """State errors of all objectives by maze and K, in both units."""
    yield from _head(["seeds", *(f"`{name}`" for name in _ORDER)])
    for k in ks:
        for maze in _measured(numbers):
            yield from _state_lines(numbers, f"K = {k}", Condition(maze, "", k))


def texture_lines(numbers: Numbers) -> Iterator[str]:
    """State errors at K = 15 with textures as exogenous noise."""
    yield from _head(["seeds", *(f"`{name}`" for name in _ORDER)])
    for maze in _measured(numbers):
        yield from _state_lines(numbers, "textures", Condition(maze, "", exogenous=True))


def budget_lines(usual: Numbers, longer: Numbers) -> Iterator[str]:
    """State errors and action losses with three curtains after 2,500 and after 20,000 steps."""
    told = [(words, steps) for words in ("state error", "action loss") for steps in ("2,500", "20,000")]
    yield from _head(["seeds", *(f"{words}, {steps} steps" for words, steps in told)])
    for method, k in (("ah+a", 15), ("ah+a", 1), ("mik+a", 15), ("mik+a", 1), ("ah", 15)):
        condition = Condition("three_curtains", method, k)
        seeds = ", ".join(str(len(values(numbers, condition, MEASURES[0]))) for numbers in (usual, longer))
        measures = (MEASURES[0], TRAINING_LOSS)
        cells = " | ".join(_cell(numbers, condition, one) for one in measures for numbers in (usual, longer))
        yield f"| `{method}`, K = {k} | {seeds} | {cells} |"


def _state_lines(numbers: Numbers, words: str, cell: Condition) -> Iterator[str]:
    """State errors of all objectives under a condition: the paper's protocol and units, then percent by the refitted
    probe.

        The condition's method is ignored; no line if no method was trained.
    """
    for told, measure in ((words, MEASURES[0]), (f"{words}, in %", REFITTED[0])):
        conditions = [cell._replace(method=name) for name in _ORDER]
        counts = {len(values(numbers, condition, measure)) for condition in conditions} - {0}
        if counts:
            seeds = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
            cells = " | ".join(_cell(numbers, condition, measure) for condition in conditions)
            yield f"| {cell.maze.replace('_', ' ')}, {told} | {seeds} | {cells} |"


def first_person_lines(numbers: Numbers) -> Iterator[str]:
    """Errors of everything trained under the compass, by increasing state error."""
    beside = "probe beside the model: position, velocity"
    yield from _head(("seeds", "state, position, velocity", beside))
    told = {
        f"`{name}`{words}": Condition(COMPASS, name, self_prediction=bool(words))
        for name in OBJECTIVES
        for words in ("", " with self-prediction")
    } | {words: Condition(COMPASS, name) for name, words in REFERENCES.items()}
    online = [one._replace(probe="online") for one in REFITTED[1:]]
    measures = [*REFITTED, *online]
    state = {name: values(numbers, condition, REFITTED[0]) for name, condition in told.items()}
    for name in sorted(filter(state.get, told), key=lambda one: np.mean(state[one])):
        cells = [_cell(numbers, told[name], one) for one in measures]
        columns = " | ".join(", ".join(cells[i:j]) for i, j in pairwise((0, 3, 5)))
        yield f"| {name} | {len(state[name])} | {columns} |"


def first_rung_lines(numbers: Numbers) -> Iterator[str]:
    """Errors of position and velocity at the smallest budget, under the stars and under the compass."""
    yield from _head((f"`{STARS}`", f"`{COMPASS}`"))
    for method in (*REFERENCES, "no_history", "mik+a", "ah+a"):
        cells = [_place_and_speed(numbers, Condition(maze, method)) for maze in (STARS, COMPASS)]
        yield f"| {_called(method)} | {' | '.join(cells)} |"


def picture_lines(usual: Numbers) -> Iterator[str]:
    """Errors of position and velocity under the stars, for the preset and then by changed setting.

    Each changed setting has one seed; `usual` are numbers of the preset.
    """
    methods = ("supervised_picture", "supervised", "mik+a")
    yield from _head([_called(name) for name in methods])
    groups: dict[str, list[NavigationRun]] = {}
    for result in read_results(RESULTS / "first_person" / "pictures"):
        config = result.record["config"]
        told = PICTURES.get(config["picture"]) or f"rate {config['learning_rate']:g}"
        groups.setdefault(told, []).extend(load_runs([result]))
    changed = {words: numbers_of(frame_of(members)) for words, members in groups.items()}
    for words, numbers in ({"the preset: grey, 50x50, rate 0.002": usual} | changed).items():
        cells = [_place_and_speed(numbers, Condition(STARS, name)) for name in methods]
        yield f"| {words} | {' | '.join(cells)} |"


def _place_and_speed(numbers: Numbers, condition: Condition) -> str:
    """Position and velocity errors of the refitted probe, in percent."""
    return ", ".join(_mean(numbers, condition, error) for error in REFITTED[1:])


def hard_lines(numbers: Numbers) -> Iterator[str]:
    """Position and velocity errors at K = 15 in the harder mazes."""
    yield from _head([f"`{maze}`" for maze in HARD])
    for method in (*_ORDER, *REFERENCES):
        conditions = [Condition(maze, method) for maze in HARD]
        if any(values(numbers, condition, REFITTED[1]) for condition in conditions):
            cells = [_place_and_speed(numbers, condition).replace("–, –", "–") for condition in conditions]
            yield f"| {_called(method)} | {' | '.join(cells)} |"
