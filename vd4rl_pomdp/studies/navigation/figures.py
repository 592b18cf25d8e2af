"""Pictures of the navigation report: accuracy bars, trajectories over the maze, and what a model is shown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from vd4rl_pomdp.envs.mazes import FREE_CELLS, HALF_SIZE, MAZES, MazeSpec
from vd4rl_pomdp.studies.navigation.claims import paper_number
from vd4rl_pomdp.studies.navigation.grid import Condition, condition_of, paper_rows
from vd4rl_pomdp.studies.navigation.measures import Measure
from vd4rl_pomdp.studies.navigation.methods import OBJECTIVES, REFERENCES
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, is_missing, read_trajectory

_ESTIMATE = "#d55e00"
_VARIANTS = {
    "K = 1": (1, False, "#9ecae1"),
    "K = 15": (15, False, "#0072b2"),
    "K = 15, self-prediction": (15, True, "#009e73"),
}
"""Bars of an objective: K, self-prediction, colour."""
_DRIVEN, _DRIVEN_ROWS = ("mik+a", "ah+a", "no_history"), 100
"""Methods whose trajectories are drawn, and how many rows of them."""
_OFFSETS, _WIDTH = (-0.27, 0.0, 0.27), 0.25
_SEED: dict[str, Any] = {"color": "black", "linestyle": "", "marker": ".", "markersize": 3}
_MARK: dict[str, Any] = {"color": "#e69f00", "linestyle": "", "marker": "_", "markersize": 9, "markeredgewidth": 2.5}
_NO_RUN: dict[str, Any] = {"color": "#999999", "linestyle": "", "marker": "x", "markersize": 4}


def accuracy_bars(runs: list[NavigationRun], measure: Measure, path: Path) -> None:
    """State prediction accuracy, 100 - error, of every objective and maze, as in the paper's bar plot.

    A panel for each maze whose runs have the measure. The paper's marks stand beside raw units alone. What a maze lacks
    and the paper, another maze or the references have is crossed.
    """
    mazes = [maze for maze in MAZES if any(run.condition.maze == maze and measure in run.values for run in runs)]
    columns = min(2, len(mazes))
    rows = -(-len(mazes) // columns)
    figure = Figure(figsize=(1 + 5.2 * columns, 0.8 + 2.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    methods = [*OBJECTIVES, *REFERENCES]
    for axes in panels.flat[len(mazes) :]:
        axes.set_axis_off()
    for axes, maze in zip(panels.flat, mazes, strict=False):
        for place, method in enumerate(methods):
            for offset, (max_k, self_prediction, colour) in zip(_OFFSETS, _VARIANTS.values(), strict=True):
                _bar(axes, place + offset, Condition(maze, method, max_k, self_prediction), runs, measure, colour)
        axes.set_title(maze, fontsize=10)
        axes.set_xticks(range(len(methods)), methods, rotation=40, ha="right", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(-0.6, len(methods) - 0.4)
    panels[0, 0].set_ylim(min(0.0, *(100 - run.values[measure] for run in runs if measure in run.values)), 100)
    for axes in panels[:, 0]:
        axes.set_ylabel(f"100 - state error ({'raw x 100' if measure.is_raw else '% of std'})")
    handles: list[Any] = [Rectangle((0, 0), 1, 1, color=colour) for *_, colour in _VARIANTS.values()]
    marks = {"a seed": _SEED, **({"the paper": _MARK} if measure.is_raw else {}), "no run": _NO_RUN}
    handles += [Line2D([], [], **style) for style in marks.values()]
    names = [*_VARIANTS, *marks]
    figure.legend(handles, names, loc="outside upper center", ncols=3 if columns == 1 else 6, frameon=False)
    figure.savefig(path, dpi=130, metadata={"Software": None})


def _bar(
    axes: Any, place: float, condition: Condition, runs: list[NavigationRun], measure: Measure, colour: str
) -> None:
    accuracy = [100 - run.values[measure] for run in runs if run.condition == condition and measure in run.values]
    if accuracy:
        axes.bar(place, np.mean(accuracy), _WIDTH, color=colour)
        axes.plot([place] * len(accuracy), accuracy, **_SEED)
    elif is_missing(condition, runs) or _in_the_paper(condition) or _is_reference(condition):
        axes.plot(place, 2, **_NO_RUN)
    paper = paper_number(condition, measure)
    if paper is not None:
        axes.plot(place, 100 - paper, **_MARK)


def _in_the_paper(condition: Condition) -> bool:
    """Whether the paper's tables have it."""
    return condition in {condition_of(row, condition.maze) for row in paper_rows()}


def _is_reference(condition: Condition) -> bool:
    """Whether it is a reference at its only K, which every maze is held against."""
    return condition == Condition(condition.maze, condition.method) and condition.method in REFERENCES


def trajectories(runs: list[NavigationRun], path: Path) -> bool:
    """A held-out trajectory over the maze with the refitted probe's estimates; False if no run has one."""
    chosen = [_first(runs, Condition(maze, method)) for maze in MAZES for method in _DRIVEN]
    found = [run for run in chosen if run is not None]
    if not found:
        return False
    mazes = [maze for maze in MAZES if any(run.condition.maze == maze for run in found)]
    methods = tuple(method for method in _DRIVEN if any(run.condition.method == method for run in found))
    figure = Figure(figsize=(3.2 * len(methods), 3.3 * len(mazes)), layout="constrained")
    panels = figure.subplots(len(mazes), len(methods), squeeze=False)
    for maze, row in zip(mazes, panels, strict=True):
        for method, axes in zip(methods, row, strict=True):
            axes.set_axis_off()
            run = _first(found, Condition(maze, method))
            if run is not None:
                _draw_trajectory(axes, run)
            else:
                axes.text(0.5, 0.5, f"{maze}: {method}\nno run", ha="center", va="center", transform=axes.transAxes)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    return True


def _first(runs: list[NavigationRun], condition: Condition) -> NavigationRun | None:
    return next((run for run in runs if run.condition == condition and run.trajectory is not None), None)


def _draw_trajectory(axes: Any, run: NavigationRun) -> None:
    assert run.trajectory is not None
    table = read_trajectory(run.trajectory)
    draw_maze(axes, MAZES[run.condition.maze])
    for names, colour, label in ((("x", "y"), "black", "true"), (("estimated_x", "estimated_y"), _ESTIMATE, "probe")):
        axes.plot(
            *(table[name][:_DRIVEN_ROWS] for name in names), color=colour, lw=1, marker=".", markersize=2.5, label=label
        )
    axes.set_title(f"{run.condition.maze}: {run.condition.method}", fontsize=9)
    axes.legend(fontsize=7, loc="center left", framealpha=0.9)


def draw_maze(axes: Any, maze: MazeSpec) -> None:
    """Walls, free cells and curtains, seen from the top."""
    axes.add_patch(Rectangle((-HALF_SIZE, -HALF_SIZE), 2 * HALF_SIZE, 2 * HALF_SIZE, color="#e4c9a8", zorder=0))
    for row, column in FREE_CELLS:
        corner = column - HALF_SIZE, HALF_SIZE - row - 1
        axes.add_patch(Rectangle(corner, 1, 1, color="#f7f7f7", zorder=0))
    for curtain in maze.curtains:
        corner = curtain.center[0] - curtain.half[0], curtain.center[1] - curtain.half[1]
        axes.add_patch(
            Rectangle(corner, 2 * curtain.half[0], 2 * curtain.half[1], color="#5b5b78", alpha=0.25, zorder=1)
        )
    axes.set(xlim=(-HALF_SIZE, HALF_SIZE), ylim=(-HALF_SIZE, HALF_SIZE), aspect="equal")


def sample_observations(samples: Mapping[str, np.ndarray], path: Path) -> None:
    """A row of pictures for each name: (n, 3, H, W) uint8, as many for all."""
    columns = max(map(len, samples.values()))
    figure = Figure(figsize=(1.5 * columns + 1.6, 1.55 * len(samples)), layout="constrained")
    panels = figure.subplots(len(samples), columns)
    for row, (name, pictures) in zip(panels, samples.items(), strict=True):
        for axes, picture in zip(row, pictures, strict=True):
            axes.imshow(picture.transpose(1, 2, 0), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(name.replace(", ", "\n"), fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})
