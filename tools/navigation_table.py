"""The tables of the pages in results/navigation, made from its rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from vd4rl_pomdp.envs.mazes import PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_and_error, number
from vd4rl_pomdp.runs.results import read_results
from vd4rl_pomdp.studies.navigation.grid import Condition
from vd4rl_pomdp.studies.navigation.measures import Measure, online_error, refitted_error
from vd4rl_pomdp.studies.navigation.methods import METHOD_NAMES, OBJECTIVES, UNTRAINED
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, load_runs
from vd4rl_pomdp.studies.navigation.tables import Entry, entry_of

RESULTS = Path(__file__).parents[1] / "results" / "navigation"
REFITTED = [refitted_error(component) for component in ("state", "position", "velocity")]
"""In percent, on held-out trajectories."""
REFITTED_RAW = [error.raw() for error in REFITTED]
MEASURES = (
    *(online_error(component).raw() for component in ("state", "position", "velocity")),
    *REFITTED,
    *REFITTED_RAW,
)
"""Of a maze's table: the paper's way and units, then both units by the refitted probe."""
REFERENCES = {
    UNTRAINED: "untrained",
    "supervised+a": "told the states: memory and actions",
    "supervised": "told the states: memory",
    "supervised_picture": "told the states: one picture",
}
"""Methods that no objective trains, as the pages call them."""
HARD_SPREADS = {
    **dict.fromkeys(("hard_no_curtain", "hard_one_curtain", "hard_three_curtains"), ((0.66, 0.85), (2.26, 2.44))),
    "hard_first_person": ((0.81, 0.93), (1.65, 1.87)),
}
"""The lesser and the greater deviation of position and of velocity in the sets, which were collected again for them:
a percentage is a mean over both coordinates, so the raw error lies between its products with the two."""
STARS, COMPASS = "first_person", "compass_first_person"
PICTURES = {"rgb50": "colour, 50x50", "rgb100": "colour, 100x100"}
"""Pictures other than the preset's, as the pages call them."""
_ORDER = ("mik+a", "fj+a", "ah", "mik", "fj", "ah+a", "no_history")
_HEAD = (
    "| | seeds | " + " | ".join(f"`{name}`" for name in _ORDER) + " |",
    "|---|---:|" + "---:|" * len(_ORDER),
)


def main_runs() -> list[NavigationRun]:
    """The runs of results/navigation, without those of folders within it."""
    return load_runs(read_results(RESULTS))


def first_person_runs() -> list[NavigationRun]:
    """The runs of the grid `first_person`."""
    return load_runs(read_results(RESULTS / "first_person"))


def first_rung_runs() -> list[NavigationRun]:
    """The runs of that grid at its smallest budget."""
    return load_runs(read_results(RESULTS / "first_person" / "small"))


def picture_runs() -> list[NavigationRun]:
    """Runs in first person with other pictures, or another learning rate, than the preset's: one seed of each."""
    return [load_runs([result])[0] for result in read_results(RESULTS / "first_person" / "pictures")]


def measured(runs: list[NavigationRun]) -> list[str]:
    """The paper's own mazes in which every objective was trained at K = 15."""
    return [
        maze
        for maze in PAPER_MAZES
        if all(len(entry_of(Condition(maze, name), MEASURES[0], runs).numbers) for name in OBJECTIVES)
    ]


def maze_lines(runs: list[NavigationRun], maze: str) -> Iterator[str]:
    """All methods at K = 15 in one maze, those with the smallest state errors first, then the references."""
    yield "| | seeds | state | position | velocity | state, position, velocity in % | the same raw x 100 |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    rows = {name: [entry_of(Condition(maze, name), one, runs) for one in MEASURES] for name in METHOD_NAMES}
    for method in (*sorted(OBJECTIVES, key=lambda name: rows[name][0].numbers.mean()), *REFERENCES):
        yield _line(_called(method), rows[method])


def state_lines(runs: list[NavigationRun], ks: Sequence[int]) -> Iterator[str]:
    """State errors of all objectives by maze and K, in both units."""
    yield from _HEAD
    for k in ks:
        for maze in measured(runs):
            yield from _state_lines(runs, f"K = {k}", Condition(maze, "", k))


def texture_lines(runs: list[NavigationRun]) -> Iterator[str]:
    """State errors at K = 15 with textures in the pictures, and without them."""
    yield from _HEAD
    for maze in measured(runs):
        if with_them := list(_state_lines(runs, "textures", Condition(maze, "", exogenous=True))):
            yield from (*with_them, *_state_lines(runs, "without", Condition(maze, "")))


def _state_lines(runs: list[NavigationRun], words: str, cell: Condition) -> Iterator[str]:
    """State errors under a condition in the paper's way and units, then in percent by the refitted probe."""
    yield from _state_line(runs, words, cell)
    yield from _state_line(runs, f"{words}, in %", cell, refitted_error("state"))


def _state_line(
    runs: list[NavigationRun], words: str, cell: Condition, measure: Measure = MEASURES[0]
) -> Iterator[str]:
    """One error of all objectives under a condition, whose method is left open; no line if none was trained."""
    entries = [entry_of(replace(cell, method=name), measure, runs) for name in _ORDER]
    counts = {len(entry.numbers) for entry in entries} - {0}
    if counts:
        seeds = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
        yield f"| {cell.maze.replace('_', ' ')}, {words} | {seeds} | {' | '.join(map(_cell, entries))} |"


def first_person_lines(runs: list[NavigationRun]) -> Iterator[str]:
    """Errors under the compass of all that was trained there, those with the smallest state errors first."""
    yield "| | seeds | state, position, velocity | raw x 100 | probe beside the model: position, velocity | raw x 100 |"
    yield "|---|---:|---:|---:|---:|---:|"
    objectives = {
        f"`{name}`{words}": Condition(COMPASS, name, self_prediction=bool(words))
        for name in OBJECTIVES
        for words in ("", " with self-prediction")
    }
    told = objectives | {words: Condition(COMPASS, name) for name, words in REFERENCES.items()}
    online = [one._replace(probe="online") for one in REFITTED[1:]]
    measures = [*REFITTED, *REFITTED_RAW, *online, *(one.raw() for one in online)]
    rows = {name: [entry_of(condition, one, runs) for one in measures] for name, condition in told.items()}
    trained = [name for name, (state, *_) in rows.items() if len(state.numbers)]
    for name in sorted(trained, key=lambda one: rows[one][0].numbers.mean()):
        cells = list(map(_cell, rows[name]))
        columns = " | ".join(", ".join(cells[i:j]) for i, j in pairwise((0, 3, 6, 8, 10)))
        yield f"| {name} | {len(rows[name][0].numbers)} | {columns} |"


def first_rung_lines(runs: list[NavigationRun]) -> Iterator[str]:
    """Errors of position and velocity at the smallest budget, under the stars and under the compass, in both units."""
    yield "| | `first_person` | raw x 100 | `compass_first_person` | raw x 100 |"
    yield "|---|---:|---:|---:|---:|"
    for method in (*REFERENCES, "no_history", "mik+a", "ah+a"):
        cells = [_place_and_speed(Condition(maze, method), runs) for maze in (STARS, COMPASS)]
        yield f"| {_called(method)} | {' | '.join(cells)} |"


def picture_lines(runs: list[NavigationRun], usual: list[NavigationRun]) -> Iterator[str]:
    """Errors of position and velocity under the stars by what is changed, in both units, below those of the preset.

    Args:
        runs: those with one setting changed.
        usual: runs of the preset.
    """
    methods = ("supervised_picture", "supervised", "mik+a")
    yield "| | " + " | ".join(f"{_called(name)} | raw x 100" for name in methods) + " |"
    yield "|---|" + "---:|" * (2 * len(methods))
    groups: dict[str, list[NavigationRun]] = {"the preset: grey, 50x50, rate 0.002": usual}
    for run in runs:
        config = run.result.record["config"]
        told = PICTURES.get(config["picture"]) or f"rate {config['learning_rate']:g}"
        groups.setdefault(told, []).append(run)
    for words, members in groups.items():
        cells = [_place_and_speed(Condition(STARS, name), members) for name in methods]
        yield f"| {words} | {' | '.join(cells)} |"


def _place_and_speed(condition: Condition, runs: list[NavigationRun]) -> str:
    """Two cells: errors of position and velocity by the refitted probe, in percent and in raw units."""
    entries = [[entry_of(condition, error, runs) for error in unit] for unit in (REFITTED[1:], REFITTED_RAW[1:])]
    return " | ".join(", ".join(map(_mean, unit)) for unit in entries)


def _called(method: str) -> str:
    """A method's name, or what the pages call a reference."""
    return REFERENCES.get(method, f"`{method}`")


def hard_lines(runs: list[NavigationRun]) -> Iterator[str]:
    """Errors of position and velocity at K = 15 in the harder mazes, with what they can be in raw units."""
    yield f"| | {' | '.join(f'`{maze}`' for maze in HARD_SPREADS)} |"
    yield "|---|" + "---:|" * len(HARD_SPREADS)
    for method in (*_ORDER, *REFERENCES):
        cells = []
        for maze, spreads in HARD_SPREADS.items():
            entries = [entry_of(Condition(maze, method), error, runs) for error in REFITTED[1:]]
            cells.append(", ".join(filter(None, map(_bounded, entries, spreads))))
        if any(cells):
            yield f"| {_called(method)} | {' | '.join(cell or number(None) for cell in cells)} |"


def _bounded(entry: Entry, spread: tuple[float, float]) -> str:
    """Percent of deviations, and the raw x 100 that it lies between; nothing if there is no seed."""
    if not len(entry.numbers):
        return ""
    low, high = (entry.numbers.mean() * deviation for deviation in spread)
    return f"{_mean(entry)} ({low:.1f} to {high:.1f})"


def _line(name: str, entries: list[Entry]) -> str:
    cells = list(map(_mean, entries[3:]))
    averages = " | ".join(map(_cell, entries[:3]))
    return f"| {name} | {len(entries[-1].numbers)} | {averages} | {', '.join(cells[:3])} | {', '.join(cells[3:])} |"


def _cell(entry: Entry) -> str:
    """Mean and standard error over seeds, and the paper's number; a dash if there is no seed."""
    shown = len(entry.numbers) and entry.paper is not None
    return _mean(entry) + (f" ({entry.paper:.1f})" if shown else "")


def _mean(entry: Entry) -> str:
    """Mean and standard error over seeds; a dash if there is no seed."""
    return mean_and_error(entry.numbers.tolist(), 1) if len(entry.numbers) else number(None)
