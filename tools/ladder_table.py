"""Make the tables and the figure of results/ladder/README.md, and the budget by its rule, from the rows there.

python tools/ladder_table.py    # draws results/ladder/ladder.png and prints the budgets
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from script import run_script

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.report.figures import Draw, looks_of, sheet, style
from vd4rl_pomdp.report.stats import mean_and_error, number
from vd4rl_pomdp.runs.critic import CONVERGED, VALUE, critic_of
from vd4rl_pomdp.runs.results import Result, read_results
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.stages import collection_of, recorded

RESULTS = Path(__file__).parents[1] / "results" / "ladder"
NEAR = 1.02
"""A held-out cloning loss counts as near the minimum up to this factor."""
UNTRAINED = ("random", "state")
"""Methods without a trained encoder, to which the rule does not apply."""
FILES = {
    "curves.csv": {"q": "q", "bc_loss": "batches"},
    "cloning.csv": {"held_out": "held_out", "trained_on": "trained_on"},
}
"""By file, its columns and the attributes of `Cell` that hold them."""
LOOKS = looks_of(())
"""Plot style by method."""
LEVERS = {
    "": "-",
    "1,024 units": "--",
    "fp32": ":",
    "20,000 steps": "-.",
    "200 episodes": (0, (4, 1, 1, 1, 1, 1)),
    "16 views": (0, (1, 1)),
}
"""Line dashes by the setting that differs from the base."""
Look = dict[str, Any]


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
        """Settings that differ from the base: 256 units, bf16, 3,000 steps, 100 episodes, 4 views."""
        levers = (
            (f"{self.units:,} units", self.units != 256),
            (self.precision, self.precision != "bf16"),
            (f"{self.steps:,} steps", self.steps != 3000),
            (f"{self.episodes} episodes", self.episodes != 100),
            (f"{self.views} views", self.views != 4),
        )
        return ", ".join(words for words, other in levers if other)

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
    told = list(zip(cells, lowest, strict=True))
    return min((rung for rung in rungs if all(cell.held_out[rung] <= NEAR * low for cell, low in told)), default=None)


def cells_in(folder: Path = RESULTS) -> list[Cell]:
    """Finished runs of a results folder with its curves.csv and cloning.csv, in grid order."""
    known: defaultdict[str, dict[str, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    for file, names in FILES.items():
        with (folder / file).open(newline="") as rows:
            for row in csv.DictReader(rows):
                for column, name in names.items():
                    known[row["run"]][name][int(row["step"])] = float(row[column])
    cells = {}
    for run in read_results(folder):
        if run.record["stage"] == "finetune" and run.finished:
            name = next(name for name in known if run.record["config"]["out"].endswith(name))
            cells[_key(run)] = _cell(run, known[name])
    return [cells[key] for key in asked() if key in cells]


def _key(run: Result) -> Key:
    config, card, made = run.record["config"], run.card, run.record["collection"]
    place = made["task"], made["quality"], card["corruption"]["corruption"], card["method"]
    own = config["hidden_dim"], config["update_precision"], card["steps"], made["episodes"], config["views"]
    return Key(*place, *own)


def _cell(run: Result, known: Mapping[str, dict[int, float]]) -> Cell:
    returns: defaultdict[int, dict[int, float]] = defaultdict(dict)
    for row in run.rows:
        if row["evaluated_under"] == row["corruption"]:
            returns[row["step"]][row["episode_seed"]] = row["return"]
    clean = [row["return"] for row in run.rows if row["evaluated_under"] == "none"][-len(returns[max(returns)]) :]
    data, gamma = run.files["reference"]["data_return"], run.record["config"]["gamma"]
    return Cell(_key(run), **known, returns=dict(returns), clean=clean, data_return=data, gamma=gamma)


def asked() -> list[Key]:
    """All cells of the ladder's grid, in order."""
    keys = []
    for cell in load_grid(str(RESULTS / "grid.toml")).cells():
        made, before, after = collection_of(cell), recorded(cell, "pretrain"), recorded(cell, "finetune")
        place = made["task"], made["quality"], before["corruption"], before["method"]
        own = after["hidden_dim"], after["update_precision"], before["steps"], made["episodes"], after["views"]
        keys.append(Key(*place, *own))
    return keys


def run_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """One row per run: where returns peak and end, and its diagnostics without evaluations."""
    yield (
        "| set (data's return) | policy | best rung: return (updates) | last rung: return (updates) | the same, played "
        "clean | critic converged at (updates) | its value at the end; the data's own | held-out cloning loss: lowest "
        "(updates), last | last on episodes of the set, on batches |"
    )
    yield "|---|---|---:|---:|---:|---:|---:|---:|---:|"
    for cell in cells:
        best = max(cell.returns, key=lambda rung: np.mean(_of(cell, rung)))
        last, lowest = max(cell.returns), min(cell.held_out, key=cell.held_out.__getitem__)
        told = [
            f"{cell.key.setting} ({cell.data_return:.0f})",
            _called(cell.key),
            *(f"{mean_and_error(_of(cell, rung))} ({rung:,})" for rung in (best, last)),
            mean_and_error(cell.clean) if cell.clean else number(None),
            _spans(cell),
            f"{cell.q[max(cell.q)]:.0f}; {cell.data_value:.0f}",
            f"{cell.held_out[lowest]:.4f} ({lowest:,}), {cell.held_out[last]:.4f}",
            f"{cell.trained_on[last]:.4f}, {cell.batches[last]:.4f}",
        ]
        yield f"| {' | '.join(told)} |"


def _of(cell: Cell, rung: int) -> list[float]:
    return list(cell.returns[rung].values())


def _called(key: Key) -> str:
    return ", ".join(filter(None, (f"`{key.method}`", key.lever)))


def _spans(cell: Cell) -> str:
    """Rungs at which the critic has converged, as ranges ("60,000 to 200,000"); a dash if there are none."""
    rungs, there = sorted(cell.held_out), set(cell.converged())
    spans: list[list[int]] = []
    for before, rung in zip([0, *rungs], rungs, strict=False):
        if rung in there:
            spans = [*spans[:-1], [spans[-1][0], rung]] if before in there else [*spans, [rung, rung]]
    return ", ".join(f"{a:,}" if a == b else f"{a:,} to {b:,}" for a, b in spans) or "at no rung"


def rung_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """Return, critic value and cloning loss of every run by rung, and the difference of `mik+a` and `acro`."""
    rungs = sorted({rung for cell in cells for rung in cell.returns})
    yield f"| set | policy | | {' | '.join(f'{rung:,}' for rung in rungs)} |"
    yield "|---|---|---|" + "---:|" * len(rungs)
    by_key = {cell.key: cell for cell in cells}

    def line(setting: str, policy: str, what: str, values: Iterable[str]) -> str:
        return f"| {setting} | {policy} | {what} | {' | '.join(values)} |"

    for cell in cells:
        told = cell.key.setting, _called(cell.key)
        there = cell.returns.keys()
        yield line(*told, "return", (mean_and_error(_of(cell, r)) if r in there else "" for r in rungs))
        yield line(*told, "critic", (f"{cell.q[r]:.0f} ({drift(cell.q, r):+.1%})" if r in there else "" for r in rungs))
        three = cell.held_out, cell.trained_on, cell.batches
        losses = ("; ".join(f"{loss[r]:.3f}" for loss in three) if r in there else "" for r in rungs)
        yield line(*told, "cloning", losses)
        other = by_key.get(cell.key._replace(method="mik+a"))
        if cell.key.method == "acro" and other:
            values = (_less(other.returns[r], cell.returns[r]) if r in there else "" for r in rungs)
            policies = ", ".join(filter(None, ("`mik+a` less `acro`", cell.key.lever)))
            yield line(cell.key.setting, policies, "return", values)


def _less(one: Mapping[int, float], other: Mapping[int, float]) -> str:
    """Difference of mean returns, with its standard error over episodes paired by seed."""
    text = mean_and_error([one[seed] - other[seed] for seed in one])
    return text if text.startswith("-") else f"+{text}"


def budget_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """The rule's budget by task and width, and the cells that are missing."""
    yield "| task | units | cells that count, of those asked for | updates by the rule | not run yet |"
    yield "|---|---:|---:|---:|---|"
    wanted: defaultdict[tuple[str, int], list[Key]] = defaultdict(list)
    for key in sorted(filter(lambda key: key.counts, asked()), key=lambda key: (-ord(key.task[0]), key.units)):
        wanted[key.task, key.units].append(key)
    for (task, units), keys in wanted.items():
        mine = [cell for cell in cells if cell.key in keys]
        there = {cell.key for cell in mine}
        found = budget(mine)
        told = "–" if not mine else "no rung" if found is None else f"{found:,}"
        missing = "; ".join(
            f"{key.quality}, `{key.method}`" + ", nothing hidden" * (key.corruption == "none")
            for key in keys
            if key not in there
        )
        told += " so far" * bool(mine and missing)
        yield f"| {task} | {units:,} | {len(mine)} of {len(keys)} | {told} | {missing or 'all are there'} |"


def figure(cells: Sequence[Cell]) -> Figure:
    """One row of panels per dataset and corruption: returns, critic values and cloning losses over updates."""
    panels: list[tuple[str, pd.DataFrame, Draw]] = []
    for task, quality, corruption in dict.fromkeys(cell.key[:3] for cell in cells):
        mine = [cell for cell in cells if cell.key[:3] == (task, quality, corruption)]
        hidden = ", nothing hidden" * (corruption == "none")
        for title, draw in PANELS.items():
            panels.append((f"{task} {quality}{hidden}: {title}", pd.DataFrame(), partial(_draw, draw, mine)))
    return sheet(panels)


def _draw(draw: Callable[[Axes, Cell, Look], None], cells: Sequence[Cell], axes: Axes, _: pd.DataFrame) -> None:
    for cell in cells:
        look = style(LOOKS[cell.key.method]) | {"linestyle": LEVERS[cell.key.lever], "lw": 1.3, "markersize": 3}
        draw(axes, cell, look)
    axes.set(xlim=(0, None), ylim=(0, None), xlabel="gradient updates, thousands")


def _draw_returns(axes: Axes, cell: Cell, look: Look) -> None:
    """Returns with standard errors over episodes."""
    rungs = np.array(sorted(cell.returns))
    means = np.array([np.mean(_of(cell, rung)) for rung in rungs])
    errors = np.array([np.std(_of(cell, rung), ddof=1) / len(_of(cell, rung)) ** 0.5 for rung in rungs])
    axes.plot(rungs / 1000, means, label=", ".join(filter(None, (cell.key.method, cell.key.lever))), **look)
    axes.fill_between(rungs / 1000, means - errors, means + errors, color=look["color"], alpha=0.15, lw=0)


def _draw_critic(axes: Axes, cell: Cell, look: Look) -> None:
    """Critic values, and the data's own; dots mark rungs at which the critic has converged."""
    steps = sorted(cell.q)
    marked = [steps.index(rung) for rung in cell.converged()]
    axes.plot(np.array(steps) / 1000, [cell.q[step] for step in steps], markevery=marked, **look)
    axes.axhline(cell.data_value, color="black", lw=0.8, linestyle=":")


def _draw_losses(axes: Axes, cell: Cell, look: Look) -> None:
    """Cloning losses: on held-out episodes, fainter on training episodes, faintest on training batches."""
    unmarked = {"marker": None}
    for losses, faint in (
        (cell.held_out, {}), (cell.trained_on, {"alpha": 0.5} | unmarked), (cell.batches, {"alpha": 0.25} | unmarked)
    ):  # fmt: skip
        axes.plot(np.array(sorted(losses)) / 1000, [losses[rung] for rung in sorted(losses)], **(look | faint))
    if not axes.texts:
        key = "dots: held-out episodes\nfainter: episodes of the set\nfaintest: batches of training"
        axes.text(0.03, 0.05, key, transform=axes.transAxes, fontsize="small", color="0.3")


PANELS = {"return": _draw_returns, "critic": _draw_critic, "cloning loss": _draw_losses}
"""Function that draws a run, by panel title."""


@dataclass(frozen=True)
class Config:
    """Draw results/ladder/ladder.png and print the budgets. No options."""


def main(config: Config) -> None:
    """Write the figure and print the budgets."""
    cells = cells_in()
    figure(cells).savefig(RESULTS / "ladder.png", dpi=150)
    print("\n".join(budget_lines(cells)))


if __name__ == "__main__":
    run_script(main, Config)
