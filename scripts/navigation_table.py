"""The tables of README.md and docs/navigation.md about the paper's own mazes, made from the rows of results/navigation.

    python scripts/navigation_table.py

A test holds the pages against them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from vd4rl_pomdp.experiments.navigation.claims import paper_number
from vd4rl_pomdp.experiments.navigation.grid import Condition
from vd4rl_pomdp.experiments.navigation.runs import NavigationRun, find_navigation, load_runs
from vd4rl_pomdp.navigation.measures import Measure, online_error, refitted_error
from vd4rl_pomdp.navigation.methods import OBJECTIVES, UNTRAINED
from vd4rl_pomdp.report.stats import mean_and_error

RESULTS = Path(__file__).parents[1] / "results" / "navigation"
MAZES = ("no_curtain", "three_curtains")
REFERENCES = {
    UNTRAINED: "untrained",
    "supervised+a": "told the states: memory and actions",
    "supervised": "told the states: memory",
    "supervised_picture": "told the states: one picture",
}
"""Methods that no objective trains, as the pages call them."""


def main_runs() -> list[NavigationRun]:
    """The runs of results/navigation, without those of folders within it."""
    return load_runs([result for result in find_navigation([RESULTS]) if result.path == RESULTS])


def maze_lines(runs: Sequence[NavigationRun], maze: str) -> Iterator[str]:
    """All methods at K = 15 in one maze, those with the smallest state errors first, then the references."""
    yield "| | seeds | state | position | velocity | position, velocity in % |"
    yield "|---|---:|---:|---:|---:|---:|"
    raw = [online_error(component).raw() for component in ("state", "position", "velocity")]
    percent = [refitted_error(component) for component in ("position", "velocity")]
    trained = [Condition(maze, name) for name in OBJECTIVES]
    for condition in sorted(trained, key=lambda condition: np.mean(_values(runs, condition, raw[0]))):
        yield _line(f"`{condition.method}`", runs, condition, raw, percent)
    for method, words in REFERENCES.items():
        yield _line(words, runs, Condition(maze, method), raw, percent)


def state_lines(runs: Sequence[NavigationRun], ks: Sequence[int]) -> Iterator[str]:
    """State errors of all objectives by maze and K."""
    methods = ("mik+a", "fj+a", "ah", "mik", "fj", "ah+a", "no_history")
    yield "| | seeds | " + " | ".join(f"`{name}`" for name in methods) + " |"
    yield "|---|---:|" + "---:|" * len(methods)
    measure = online_error("state").raw()
    for k in ks:
        for maze in MAZES:
            conditions = [Condition(maze, name, k) for name in methods]
            cells = [_cell(_values(runs, one, measure), paper_number(one, measure)) for one in conditions]
            counts = {len(_values(runs, one, measure)) for one in conditions} - {0}
            seeds = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
            yield f"| {maze.replace('_', ' ')}, K = {k} | {seeds} | {' | '.join(cells)} |"


def _line(
    name: str, runs: Sequence[NavigationRun], condition: Condition, raw: list[Measure], percent: list[Measure]
) -> str:
    cells = [_cell(_values(runs, condition, measure), paper_number(condition, measure)) for measure in raw]
    shares = ", ".join(_cell(_values(runs, condition, measure), None) for measure in percent)
    seeds = len(_values(runs, condition, percent[0]))
    return f"| {name} | {seeds} | {' | '.join(cells)} | {shares} |"


def _values(runs: Sequence[NavigationRun], condition: Condition, measure: Measure) -> list[float]:
    return [run.values[measure] for run in runs if run.condition == condition and measure in run.values]


def _cell(values: Sequence[float], paper: float | None) -> str:
    """Mean and standard error over seeds, and the paper's number; a dash if there is no seed."""
    if not values:
        return "–"
    return mean_and_error(values, 1) + ("" if paper is None else f" ({paper:.1f})")


if __name__ == "__main__":
    found = main_runs()
    for lines in (state_lines(found, (15, 1)), *(maze_lines(found, maze) for maze in MAZES), state_lines(found, (1,))):
        print("\n".join(lines), end="\n\n")
