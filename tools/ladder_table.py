"""Make the tables and the figure of results/ladder/README.md, and the budget by its rule, from the rows there.

python tools/ladder_table.py    # draws results/ladder/ladder.png and prints the budgets
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from earlier_table import signed
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.text import table_lines
from vd4rl_pomdp.report.figures import looks_of, sheet, style
from vd4rl_pomdp.report.stats import mean_and_error, number
from vd4rl_pomdp.runs.critic import CONVERGED, VALUE, critic_of
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import read_results
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.stages import collection_of, recorded

RESULTS = Path(__file__).parents[1] / "results" / "ladder"
NEAR = 1.02
"""A held-out cloning loss counts as near the minimum up to this factor."""
UNTRAINED = ("random", "state")
"""Methods without a trained encoder, to which the rule does not apply."""
LOOKS = looks_of(())
"""Plot style by method."""
BASE = (256, "bf16", 3000, 100, 4)
"""Units, precision, pretraining steps, episodes of the dataset and views of the first rungs."""
LEVERS = {
    "": "-",
    "1,024 units": "--",
    "fp32": ":",
    "20,000 steps": "-.",
    "200 episodes": (0, (4, 1, 1, 1, 1, 1)),
    "16 views": (0, (1, 1)),
}
"""Line dashes by the setting that differs from the base."""


class Key(NamedTuple):
    """Identifies a cell of the ladder."""

    task: str
    quality: str
    corruption: str
    method: str
    units: int
    precision: str
    steps: int
    """Pretraining steps."""
    episodes: int
    """Episodes of the dataset."""
    views: int

    @property
    def setting(self) -> str:
        """Task, quality and corruption in words."""
        return f"{self.task}, {self.quality}" + ", nothing hidden" * (self.corruption == "none")

    @property
    def lever(self) -> str:
        """Settings that differ from the base, in words."""
        words = ("{:,} units", "{}", "{:,} steps", "{} episodes", "{} views")
        settings = zip(words, self[4:], BASE, strict=True)
        return ", ".join(word.format(value) for word, value, base in settings if value != base)

    @property
    def called(self) -> str:
        """Method and settings that differ from the base."""
        return ", ".join(filter(None, (f"`{self.method}`", self.lever)))

    @property
    def counts(self) -> bool:
        """Whether the rule applies: a trained encoder, and base settings except for the width."""
        return self.method not in UNTRAINED and self._replace(units=256).lever == ""


@dataclass(frozen=True)
class Cell:
    """A finished run of the ladder."""

    key: Key
    q: Mapping[int, float]
    """Mean Q of the data's actions by update, each a mean since the previous row."""
    held_out: Mapping[int, float]
    """Cloning loss on held-out episodes by rung."""
    trained_on: Mapping[int, float] = field(default_factory=dict)
    """Cloning loss on training episodes, with corruption drawn anew."""
    batches: Mapping[int, float] = field(default_factory=dict)
    """Cloning loss on training batches, each a mean since the previous row."""
    returns: Mapping[int, Mapping[int, float]] = field(default_factory=dict)
    """By rung, return by episode seed, evaluated as trained."""
    clean: Sequence[float] = ()
    """Returns at the last rung without corruption."""
    data_return: float = float("nan")
    gamma: float = float("nan")

    @property
    def data_value(self) -> float:
        """The data's discounted return: mean reward / (1 - gamma), since only the time limit ends episodes."""
        return self.data_return / TASKS.named(self.key.task).decisions / (1 - self.gamma)

    def converged(self) -> list[int]:
        """Rungs at which the critic has converged."""
        return [rung for rung in sorted(self.held_out) if abs(drift(self.q, rung)) < CONVERGED]


def drift(curve: Mapping[int, float], end: int) -> float:
    """Relative change of a critic's value over the last fifth of `end` updates, as if training had ended there.

    As in `critic_of` for a whole run; NaN if the curve has too few values.
    """
    rows = [{"step": step, VALUE: value} for step, value in curve.items() if step <= end]
    moved = critic_of(rows, end, None, None).get("moved")
    return float("nan") if moved is None else moved


def budget(cells: Sequence[Cell]) -> int | None:
    """Smallest number of updates, among the rungs, that satisfies a rule without evaluations; None if there is none.

    All critics have converged there, and each held-out cloning loss is within 2% of its minimum over all such rungs.
    """
    rungs = set.intersection(*(set(cell.converged()) for cell in cells)) if cells else set()
    lowest = [min((cell.held_out[rung] for rung in rungs), default=0.0) for cell in cells]
    pairs = list(zip(cells, lowest, strict=True))
    return min((rung for rung in rungs if all(cell.held_out[rung] <= NEAR * low for cell, low in pairs)), default=None)


def cells_in() -> list[Cell]:
    """Finished runs of results/ladder with its curves.csv and cloning.csv, in grid order."""
    curves, cloning = (
        dict(list(pd.read_csv(RESULTS / file, index_col="step").groupby("run")))
        for file in ("curves.csv", "cloning.csv")
    )
    cells = {}
    for run in read_results(RESULTS):
        if run.record["stage"] == "finetune" and run.finished:
            config = run.record["config"]
            card = run.card | {"corruption": run.card["corruption"]["corruption"]}
            name = next(name for name in curves if config["out"].endswith(name))
            q, batches = (curves[name][column].to_dict() for column in ("q", "bc_loss"))
            held_out, trained_on = (cloning[name][column].to_dict() for column in ("held_out", "trained_on"))
            trained = (row for row in run.rows if row["evaluated_under"] == row["corruption"])
            by_rung = groups(trained, lambda row: row["step"])
            returns = {rung: {row["episode_seed"]: row["return"] for row in rows} for rung, rows in by_rung.items()}
            clean = [row["return"] for row in run.rows if row["evaluated_under"] == "none"]
            key, clean = _key(run.record["collection"], card, config), clean[-len(returns[max(returns)]) :]
            data, gamma = run.files["reference"]["data_return"], config["gamma"]
            cells[key] = Cell(key, q, held_out, trained_on, batches, returns, clean, data, gamma)
    return [cells[key] for key in grid_keys() if key in cells]


def _key(made: Row, before: Row, after: Row) -> Key:
    place = made["task"], made["quality"], before["corruption"], before["method"]
    settings = after["hidden_dim"], after["update_precision"], before["steps"], made["episodes"], after["views"]
    return Key(*place, *settings)


def grid_keys() -> list[Key]:
    """All cells of the ladder's grid, in order."""
    cells = load_grid(str(RESULTS / "grid.toml")).cells()
    return [_key(collection_of(cell), recorded(cell, "pretrain"), recorded(cell, "finetune")) for cell in cells]


def run_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """One row per run: where returns peak and end, and its diagnostics without evaluations."""
    rows = []
    for cell in cells:
        best = max(cell.returns, key=lambda rung: np.mean(_of(cell, rung)))
        last, lowest = max(cell.returns), min(cell.held_out, key=cell.held_out.__getitem__)
        row = [
            f"{cell.key.setting} ({cell.data_return:.0f})",
            cell.key.called,
            *(f"{mean_and_error(_of(cell, rung))} ({rung:,})" for rung in (best, last)),
            mean_and_error(cell.clean) if cell.clean else number(None),
            _spans(cell),
            f"{cell.q[max(cell.q)]:.0f}; {cell.data_value:.0f}",
            f"{cell.held_out[lowest]:.4f} ({lowest:,}), {cell.held_out[last]:.4f}",
            f"{cell.trained_on[last]:.4f}, {cell.batches[last]:.4f}",
        ]
        rows.append(row)
    head = ["set (data's return)", "policy", "best rung: return (updates)", "last rung: return (updates)"]
    head += ["the same, evaluated clean", "rungs with a converged critic", "its final value; the data's own"]
    head += ["held-out cloning loss: lowest (updates), last", "last on dataset episodes, on batches"]
    return table_lines(head, rows, (0, 1))


def _of(cell: Cell, rung: int) -> list[float]:
    return list(cell.returns[rung].values())


def _spans(cell: Cell) -> str:
    """Rungs at which the critic has converged, with neighbors merged: "60,000 to 200,000"."""
    rungs, there = sorted(cell.held_out), set(cell.converged())
    spans: list[list[int]] = []
    for before, rung in zip([0, *rungs], rungs, strict=False):
        if rung in there:
            spans = [*spans[:-1], [spans[-1][0], rung]] if before in there else [*spans, [rung, rung]]
    return ", ".join(f"{a:,}" if a == b else f"{a:,} to {b:,}" for a, b in spans) or "at no rung"


def rung_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """Return of each run by rung, and the differences of `mik+a` and `acro`, and of views; last, means over rungs."""
    rungs, rows = sorted({rung for cell in cells for rung in cell.returns}), []
    by_key = {cell.key: cell for cell in cells}
    for cell in cells:
        means = [sum(one.values()) / len(one) for one in cell.returns.values()]
        line = {rung: mean_and_error(_of(cell, rung)) for rung in cell.returns}
        rows.append((cell, cell.key.called, line, f"{np.mean(means):.0f}" if means else ""))
        pairs = [(cell, by_key.get(cell.key._replace(views=BASE[-1])))] if cell.key.views != BASE[-1] else []
        pairs += [(by_key.get(cell.key._replace(method="mik+a")), cell)] if cell.key.method == "acro" else []
        for one, other in pairs:
            if one and other:  # with the standard error over the episodes' common starts
                apart = {
                    rung: [value - other.returns[rung][seed] for seed, value in mine.items()]
                    for rung, mine in one.returns.items()
                }
                line = {rung: signed(mean_and_error(values)) for rung, values in apart.items()}
                mean = np.mean([np.mean(values) for values in apart.values()])
                rows.append((cell, f"{one.key.called} minus {other.key.called}", line, signed(f"{mean:.0f}")))
    table = (
        (cell.key.setting, called, *(line.get(rung, "") for rung in rungs), mean) for cell, called, line, mean in rows
    )
    return table_lines(("set", "return of", *(f"{rung:,}" for rung in rungs), "mean"), table, (0, 1))


def budget_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """The rule's budget per task and width, and the runs that it still lacks."""
    wanted = groups((key for key in grid_keys() if key.counts), lambda key: (key.task, key.units))
    rows = []
    for (task, units), keys in sorted(wanted.items(), key=lambda item: (-ord(item[0][0][0]), item[0][1])):
        mine = [cell for cell in cells if cell.key in keys]
        there, found = {cell.key for cell in mine}, budget(mine)
        updates = "–" if not mine else "no rung" if found is None else f"{found:,}"
        hidden = {key: ", nothing hidden" * (key.corruption == "none") for key in keys if key not in there}
        missing = "; ".join(f"{key.quality}, `{key.method}`{words}" for key, words in hidden.items())
        updates += " so far" * bool(mine and missing)
        rows.append((task, f"{units:,}", f"{len(mine)} of {len(keys)}", updates, missing or "none"))
    head = ("task", "units", "cells that count, of those required", "updates by the rule", "not run yet")
    return table_lines(head, rows, (0, 4))


def figure(cells: Sequence[Cell]) -> Figure:
    """One row of panels per dataset and corruption: returns, critic value, and cloning losses by updates."""
    panels: list[tuple[str, Any, Any]] = []
    for (task, quality, corruption), mine in groups(cells, lambda cell: cell.key[:3]).items():
        hidden = ", nothing hidden" * (corruption == "none")
        for title, draw in PANELS.items():
            panels.append((f"{task} {quality}{hidden}: {title}", mine, partial(_draw, draw)))
    return sheet(panels)


def _draw(draw: Any, axes: Axes, cells: Sequence[Cell]) -> None:
    for cell in cells:
        look = style(LOOKS[cell.key.method]) | {"linestyle": LEVERS[cell.key.lever], "lw": 1.3, "markersize": 3}
        draw(axes, cell, look)
    axes.set(xlim=(0, None), ylim=(0, None), xlabel="gradient updates, thousands")


def _draw_returns(axes: Axes, cell: Cell, look: dict[str, Any]) -> None:
    """Returns with standard errors over episodes."""
    rungs = np.array(sorted(cell.returns))
    means = np.array([np.mean(_of(cell, rung)) for rung in rungs])
    errors = np.array([np.std(_of(cell, rung), ddof=1) / len(cell.returns[rung]) ** 0.5 for rung in rungs])
    axes.plot(rungs / 1000, means, label=cell.key.called.replace("`", ""), **look)
    axes.fill_between(rungs / 1000, means - errors, means + errors, color=look["color"], alpha=0.15, lw=0)


def _draw_critic(axes: Axes, cell: Cell, look: dict[str, Any]) -> None:
    """Critic values, and the data's own; dots mark rungs at which the critic has converged."""
    steps = sorted(cell.q)
    marked = [steps.index(rung) for rung in cell.converged()]
    axes.plot(np.array(steps) / 1000, [cell.q[step] for step in steps], markevery=marked, **look)
    axes.axhline(cell.data_value, color="black", lw=0.8, linestyle=":")


def _draw_losses(axes: Axes, cell: Cell, look: dict[str, Any]) -> None:
    """Cloning losses: on held-out episodes, fainter on training episodes, faintest on training batches."""
    for losses, alpha in ((cell.held_out, None), (cell.trained_on, 0.5), (cell.batches, 0.25)):
        faint = {"alpha": alpha, "marker": None} if alpha else {}
        axes.plot(np.array(sorted(losses)) / 1000, [losses[rung] for rung in sorted(losses)], **(look | faint))
    if not axes.texts:
        key = "dots: held-out episodes\nfainter: dataset episodes\nfaintest: training batches"
        axes.text(0.03, 0.05, key, transform=axes.transAxes, fontsize="small", color="0.3")


PANELS = {"return": _draw_returns, "critic": _draw_critic, "cloning loss": _draw_losses}
"""Function that draws a run, by panel title."""


def main() -> None:
    """Write the figure and print the budgets."""
    cells = cells_in()
    figure(cells).savefig(RESULTS / "ladder.png", dpi=150)
    print("\n".join(budget_lines(cells)))


if __name__ == "__main__":
    main()
