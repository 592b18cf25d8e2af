"""Figures of the navigation study: accuracy bars, trajectories over the maze, sample observations, and a video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from vd4rl_pomdp.envs.mazes import BALL_RADIUS, FREE_CELLS, HALF_SIZE, MAZES, MazeSpec
from vd4rl_pomdp.studies.navigation.runs import (
    OBJECTIVES,
    REFERENCES,
    Condition,
    Measure,
    NavigationRun,
    condition_of,
    is_missing,
    numbers_of,
    paper_number,
    paper_rows,
    read_trajectory,
)

_TRUE, _ESTIMATE = "#009e73", "#d55e00"
_VARIANTS = {
    "K = 1": (1, False, "#9ecae1"),
    "K = 15": (15, False, "#0072b2"),
    "K = 15, self-prediction": (15, True, "#009e73"),
}
"""Bars of an objective: K, self-prediction, colour."""
_DRIVEN, _DRIVEN_ROWS = ("mik+a", "ah+a", "no_history"), 100
"""Methods whose trajectories are drawn, and the number of rows."""
_OFFSETS, _WIDTH = (-0.27, 0.0, 0.27), 0.25
_SEED: dict[str, Any] = {"color": "black", "linestyle": "", "marker": ".", "markersize": 3}
_MARK: dict[str, Any] = {"color": "#e69f00", "linestyle": "", "marker": "_", "markersize": 9, "markeredgewidth": 2.5}
_NO_RUN: dict[str, Any] = {"color": "#999999", "linestyle": "", "marker": "x", "markersize": 4}


def accuracy_bars(runs: list[NavigationRun], measure: Measure, path: Path) -> bool:
    """Bar plot of state prediction accuracy, 100 - error, by objective and maze, as in the paper.

    One panel per maze with runs of the measure; False, without a file, if there are none. The paper's numbers are shown
    only for raw units. Crosses mark missing runs that the paper, another maze or the references have.
    """
    numbers, methods = numbers_of(runs), [*OBJECTIVES, *REFERENCES]
    measured = [run for run in runs if measure in run.values]
    mazes = [maze for maze in MAZES if any(run.condition.maze == maze for run in measured)]
    if not mazes:
        return False
    columns = min(2, len(mazes))
    rows = -(-len(mazes) // columns)
    figure = Figure(figsize=(1 + 5.2 * columns, 0.8 + 2.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    trained, expected = {run.condition for run in runs}, {condition_of(row, "") for row in paper_rows()}
    expected |= {Condition("", method) for method in REFERENCES}
    for axes in panels.flat[len(mazes) :]:
        axes.set_axis_off()
    for axes, maze in zip(panels.flat, mazes, strict=False):
        for place, method in enumerate(methods):
            for offset, (max_k, self_prediction, colour) in zip(_OFFSETS, _VARIANTS.values(), strict=True):
                condition, at = Condition(maze, method, max_k, self_prediction), place + offset
                if accuracy := [100 - error for error in numbers.get((condition, measure), {}).values()]:
                    axes.bar(at, np.mean(accuracy), _WIDTH, color=colour)
                    axes.plot([at] * len(accuracy), accuracy, **_SEED)
                elif condition._replace(maze="") in expected or is_missing(condition, trained):
                    axes.plot(at, 2, **_NO_RUN)
                if (paper := paper_number(condition, measure)) is not None:
                    axes.plot(at, 100 - paper, **_MARK)
        axes.set_title(maze, fontsize=10)
        axes.set_xticks(range(len(methods)), methods, rotation=40, ha="right", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(-0.6, len(methods) - 0.4)
    panels[0, 0].set_ylim(min(0.0, 100 - max(run.values[measure] for run in measured)), 100)
    for axes in panels[:, 0]:
        axes.set_ylabel(f"100 - state error ({'raw x 100' if measure.is_raw else '% of std'})")
    handles: list[Any] = [Rectangle((0, 0), 1, 1, color=colour) for *_, colour in _VARIANTS.values()]
    marks = {"a seed": _SEED, **({"the paper": _MARK} if measure.is_raw else {}), "no run": _NO_RUN}
    handles += [Line2D([], [], **style) for style in marks.values()]
    legend: dict[str, Any] = {"loc": "outside upper center", "ncols": 3 if columns == 1 else 6, "frameon": False}
    figure.legend(handles, [*_VARIANTS, *marks], **legend)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    return True


def trajectories(runs: list[NavigationRun], path: Path) -> bool:
    """A held-out trajectory over the maze with the refitted probe's estimates; False if no run has one."""
    found: dict[Condition, Path] = {}
    for run in runs:
        if run.trajectory is not None and run.condition == Condition(run.condition.maze, run.condition.method):
            found.setdefault(run.condition, run.trajectory)
    methods = [method for method in _DRIVEN if any(condition.method == method for condition in found)]
    mazes = [maze for maze in MAZES if any(Condition(maze, method) in found for method in methods)]
    if not mazes:
        return False
    figure = Figure(figsize=(3.2 * len(methods), 3.3 * len(mazes)), layout="constrained")
    panels = figure.subplots(len(mazes), len(methods), squeeze=False)
    for maze, row in zip(mazes, panels, strict=True):
        for method, axes in zip(methods, row, strict=True):
            axes.set_axis_off()
            if (condition := Condition(maze, method)) not in found:
                axes.text(0.5, 0.5, f"{maze}: {method}\nno run", ha="center", va="center", transform=axes.transAxes)
                continue
            _draw_maze(axes, MAZES[maze])
            table = read_trajectory(found[condition])
            for before, colour, label in (("", "black", "true"), ("estimated_", _ESTIMATE, "probe")):
                points = [table[f"{before}{name}"][:_DRIVEN_ROWS] for name in "xy"]
                axes.plot(*points, color=colour, lw=1, marker=".", markersize=2.5, label=label)
            axes.legend(fontsize=7, loc="center left", framealpha=0.9)
            axes.set_title(f"{maze}: {method}", fontsize=9)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    return True


def observations(samples: Mapping[str, np.ndarray], path: Path) -> bool:
    """One row of images per name: (n, 3, H, W) uint8, with equal n."""
    columns = max(map(len, samples.values()))
    figure = Figure(figsize=(1.5 * columns + 1.6, 1.55 * len(samples)), layout="constrained")
    panels = figure.subplots(len(samples), columns)
    for row, (name, pictures) in zip(panels, samples.items(), strict=True):
        for axes, picture in zip(row, pictures, strict=True):
            axes.imshow(picture.transpose(1, 2, 0), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(name.replace(", ", "\n"), fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    return True


def write_film(trajectories: Mapping[str, Path], maze: MazeSpec, path: Path) -> None:
    """Write an animated GIF, slightly slower than real time, with one panel per name.

    The true mass is a green disc, visible through the curtains here; the estimate is an orange ring. `trajectories`
    are the trajectory.csv of runs on that maze.
    """
    tables = {name: read_trajectory(file) for name, file in trajectories.items()}
    figure = Figure(figsize=(2.4 * len(tables), 2.6))
    figure.subplots_adjust(left=0, right=1, bottom=0, top=2.4 / 2.6, wspace=0)
    discs = []
    for axes, name in zip(figure.subplots(1, len(tables), squeeze=False).flat, tables, strict=True):
        _draw_maze(axes, maze)
        axes.set_axis_off()
        axes.set_title(f"{name}: mass and estimate", fontsize=9, pad=2)
        mass = Circle((0, 0), BALL_RADIUS, color=_TRUE, zorder=2)
        estimate = Circle((0, 0), BALL_RADIUS, fill=False, edgecolor=_ESTIMATE, linewidth=2, zorder=3)
        discs.append((axes.add_patch(mass), axes.add_patch(estimate)))
    writer = PillowWriter(fps=12)
    with writer.saving(figure, str(path), dpi=100):
        for row in range(min(map(len, tables.values()))):
            for (mass, estimate), table in zip(discs, tables.values(), strict=True):
                mass.center = table["x"][row], table["y"][row]
                estimate.center = table["estimated_x"][row], table["estimated_y"][row]
            writer.grab_frame()


def _draw_maze(axes: Axes, maze: MazeSpec) -> None:
    """Walls, free cells and translucent curtains of a maze from above."""
    axes.add_patch(Rectangle((-HALF_SIZE, -HALF_SIZE), 2 * HALF_SIZE, 2 * HALF_SIZE, color="#e4c9a8", zorder=0))
    for i, j in FREE_CELLS:
        axes.add_patch(Rectangle((j - HALF_SIZE, HALF_SIZE - i - 1), 1, 1, color="#f7f7f7", zorder=0))
    for (x, y), (half_x, half_y) in ((curtain.center, curtain.half) for curtain in maze.curtains):
        corner, size = (x - half_x, y - half_y), (2 * half_x, 2 * half_y)
        axes.add_patch(Rectangle(corner, *size, color="#5b5b78", alpha=0.25, zorder=1))
    axes.set(xlim=(-HALF_SIZE, HALF_SIZE), ylim=(-HALF_SIZE, HALF_SIZE), aspect="equal")
