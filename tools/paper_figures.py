"""Draw the paper's two offline figures (patches; patches and zeroed frames) in its layout, from the rows of a page.

    python tools/paper_figures.py        writes figures/paper_CORRUPTION.png of results/earlier and results/protocol

Panels are the paper's tasks and qualities, rows its methods. What was not run is shown as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import earlier_table as earlier
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from protocol_table import GRU, called

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.report.figures import COLOURS, sheet
from vd4rl_pomdp.report.gates import episodes_of
from vd4rl_pomdp.report.load import Run
from vd4rl_pomdp.report.stats import mean_interval
from vd4rl_pomdp.runs.files import groups

TASKS_SHOWN, QUALITIES = ("cheetah_run", "walker_walk", "humanoid_walk"), ("expert", "medium_expert")
METHODS = ("mik+a", "mik", "ah+a", "ah", "fj+a", "fj", "acro", "driml", "homer", "curl", "one_step_inverse")
HIDDEN = ("patch", "patch+zero_frames")


def figures(runs: Sequence[Run]) -> dict[str, Figure]:
    """A figure for each of the paper's corruptions under which any run was evaluated, by corruption."""
    found = {}
    for corruption in HIDDEN:
        here = [run for run in runs if run.labels["corruption"] == corruption]
        if here:
            panels = []
            for quality, task in product(QUALITIES, TASKS_SHOWN):
                mine = [run for run in here if run.of(("task", "quality")) == (task, quality)]
                panels.append((f"{task} {quality}", pd.DataFrame(), partial(_draw, mine)))
            found[corruption] = sheet(panels, 3, [2.6] * len(panels))
    return found


def _draw(runs: list[Run], axes: Axes, _: pd.DataFrame) -> None:
    by_method = groups(runs, lambda run: called(run).replace(GRU, "ah"))
    for place, method in enumerate(METHODS):
        mine = by_method.get(method)
        if not mine:
            axes.text(1, place, "not run", va="center", fontsize=6, color="grey")
            continue
        returns = episodes_of(mine) / TASKS[mine[0].labels["task"]].score_divisor
        ends = mean_interval(returns)
        axes.barh(place, returns.mean(), 0.75, color=COLOURS[0], alpha=0.55)
        axes.hlines(place, *(ends or [returns.mean()] * 2), color="black", lw=1.2, zorder=3)
        axes.scatter(returns.mean(1), np.full(len(mine), place), 7, color=COLOURS[0], ec="black", lw=0.4, zorder=4)
        axes.text(max([*returns.mean(1), *(ends or ())]) + 2, place, f"n = {len(mine)}", va="center", fontsize=6)
    if runs and (data := runs[0].reference.data_return):
        axes.axvline(data / TASKS[runs[0].labels["task"]].score_divisor, color="black", ls=":", lw=1)
    axes.set_yticks(range(len(METHODS)), METHODS, fontsize=7)
    axes.set(xlim=(0, 100), ylim=(len(METHODS) - 0.4, -0.6), xlabel="score")
    axes.grid(axis="y", visible=False)


def main() -> None:
    """Write the figures of both pages."""
    frozen = earlier.runs_of([str(earlier.RESULTS / "protocol.toml")], ["protocol"])
    for page, runs in {"earlier": earlier.main_runs(), "protocol": frozen}.items():
        for corruption, figure in figures(runs).items():
            figure.savefig(earlier.RESULTS / page / "figures" / f"paper_{corruption}.png", dpi=100)


if __name__ == "__main__":
    main()
