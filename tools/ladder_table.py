"""The tables and the figure of results/ladder/README.md, and the budget that its rule gives, made from its rows.

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
"""A held-out cloning loss is near the lowest if it is no more than so many times it."""
UNTRAINED = ("random", "state")
"""Methods that train no encoder, which do not count for the rule."""
FILES = {
    "curves.csv": {"q": "q", "bc_loss": "batches"},
    "cloning.csv": {"held_out": "held_out", "trained_on": "trained_on"},
}
"""Columns of the files beside a run's rows, and what a cell calls them."""
LOOKS = looks_of(())
"""Numbers of looks by method."""
LEVERS = {
    "": "-",
    "1,024 units": "--",
    "fp32": ":",
    "20,000 steps": "-.",
    "200 episodes": (0, (4, 1, 1, 1, 1, 1)),
    "16 views": (0, (1, 1)),
}
"""Dashes by what is not as in the first rungs."""
Look = dict[str, Any]


class Key(NamedTuple):
    """What tells a cell of the ladder from others."""

    task: str
    quality: str
    corruption: str
    method: str
    units: int
    precision: str
    steps: int
    """Of pretraining."""
    episodes: int
    """Of the set."""
    views: int

    @property
    def setting(self) -> str:
        """Where it is trained, in words."""
        return f"{self.task}, {self.quality}" + ", nothing hidden" * (self.corruption == "none")

    @property
    def lever(self) -> str:
        """What is not as in the first rungs: 256 units, bf16, 3,000 steps, 100 episodes, 4 views."""
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
        """Whether the rule asks it: a trained encoder, and no lever pulled but the width."""
        return self.method not in UNTRAINED and self._replace(units=256).lever == ""


@dataclass(frozen=True)
class Cell:
    """A finished run of the ladder."""

    key: Key
    q: Mapping[int, float]
    """Mean value of the data's actions by update, each a mean over the updates since the one before."""
    held_out: Mapping[int, float]
    """Cloning loss on held-out episodes by rung."""
    trained_on: Mapping[int, float] = field(default_factory=dict)
    """The same on episodes of the set, in a draw of corruption that was not learned from."""
    batches: Mapping[int, float] = field(default_factory=dict)
    """The same on the batches of training, each a mean over the updates since the one before."""
    returns: Mapping[int, Mapping[int, float]] = field(default_factory=dict)
    """Of the episodes of each rung by their seeds, played as trained."""
    clean: Sequence[float] = ()
    """Of the last rung, played with nothing hidden."""
    data_return: float = float("nan")
    gamma: float = float("nan")

    @property
    def data_value(self) -> float:
        """The data's own discounted return: their mean reward over 1 - gamma, as no episode ends but by its time."""
        return self.data_return / TASKS.named(self.key.task).decisions / (1 - self.gamma)

    def converged(self) -> list[int]:
        """Rungs at which the critic has converged."""
        return [rung for rung in sorted(self.held_out) if abs(drift(self.q, rung)) < CONVERGED]


def drift(curve: Mapping[int, float], end: int) -> float:
    """By which share of its value a critic moved over the last fifth of `end` updates, as if training had ended there.

    As `critic_of` tells it of a whole run; not a number where the curve has too few values for that.
    """
    rows = [{"step": step, VALUE: value} for step, value in curve.items() if step <= end]
    moved = critic_of(rows, end, None, None).get("moved")
    return float("nan") if moved is None else moved


def budget(cells: Sequence[Cell]) -> int | None:
    """The fewest updates, among the rungs of all cells, that suffice by a rule that looks at no evaluation.

    The critics of all cells have converged there, and in each the cloning loss on held-out episodes is within 2% of its
    lowest over all such rungs. None: there is no such rung.
    """
    rungs = set.intersection(*(set(cell.converged()) for cell in cells)) if cells else set()
    lowest = [min((cell.held_out[rung] for rung in rungs), default=0.0) for cell in cells]
    told = list(zip(cells, lowest, strict=True))
    return min((rung for rung in rungs if all(cell.held_out[rung] <= NEAR * low for cell, low in told)), default=None)


def cells_in(folder: Path = RESULTS) -> list[Cell]:
    """Finished runs of a results folder with its curves.csv and cloning.csv, in the order of the grid."""
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
    """All cells of the ladder's grid, in its order."""
    keys = []
    for cell in load_grid(str(RESULTS / "grid.toml")).cells():
        made, before, after = collection_of(cell), recorded(cell, "pretrain"), recorded(cell, "finetune")
        place = made["task"], made["quality"], before["corruption"], before["method"]
        own = after["hidden_dim"], after["update_precision"], before["steps"], made["episodes"], after["views"]
        keys.append(Key(*place, *own))
    return keys


def run_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """A row for every run: where its returns peak and end, and what is known of them without an evaluation."""
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
    """Rungs at which the critic has converged, neighbours as one: "60,000 to 200,000"; a dash if there are none."""
    rungs, there = sorted(cell.held_out), set(cell.converged())
    spans: list[list[int]] = []
    for before, rung in zip([0, *rungs], rungs, strict=False):
        if rung in there:
            spans = [*spans[:-1], [spans[-1][0], rung]] if before in there else [*spans, [rung, rung]]
    return ", ".join(f"{a:,}" if a == b else f"{a:,} to {b:,}" for a, b in spans) or "at no rung"


def rung_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """Return, critic's value and cloning loss of every run by rung, and by how much `mik+a` is above `acro`."""
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
    """Mean of returns less that of others, and its standard error over the episodes' common starts."""
    text = mean_and_error([one[seed] - other[seed] for seed in one])
    return text if text.startswith("-") else f"+{text}"


def budget_lines(cells: Sequence[Cell]) -> Iterator[str]:
    """What the rule gives for each task and width, and which of its cells are not there yet."""
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
    """A row of panels for every set and corruption: returns, the critic's value, and cloning losses by updates."""
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
    """With standard errors over episodes."""
    rungs = np.array(sorted(cell.returns))
    means = np.array([np.mean(_of(cell, rung)) for rung in rungs])
    errors = np.array([np.std(_of(cell, rung), ddof=1) / len(_of(cell, rung)) ** 0.5 for rung in rungs])
    axes.plot(rungs / 1000, means, label=", ".join(filter(None, (cell.key.method, cell.key.lever))), **look)
    axes.fill_between(rungs / 1000, means - errors, means + errors, color=look["color"], alpha=0.15, lw=0)


def _draw_critic(axes: Axes, cell: Cell, look: Look) -> None:
    """Beside the data's own value; a dot at every rung at which it has converged."""
    steps = sorted(cell.q)
    marked = [steps.index(rung) for rung in cell.converged()]
    axes.plot(np.array(steps) / 1000, [cell.q[step] for step in steps], markevery=marked, **look)
    axes.axhline(cell.data_value, color="black", lw=0.8, linestyle=":")


def _draw_losses(axes: Axes, cell: Cell, look: Look) -> None:
    """On held-out episodes; fainter on those of the set, and faintest on the batches of training."""
    unmarked = {"marker": None}
    for losses, faint in (
        (cell.held_out, {}), (cell.trained_on, {"alpha": 0.5} | unmarked), (cell.batches, {"alpha": 0.25} | unmarked)
    ):  # fmt: skip
        axes.plot(np.array(sorted(losses)) / 1000, [losses[rung] for rung in sorted(losses)], **(look | faint))
    if not axes.texts:
        key = "dots: held-out episodes\nfainter: episodes of the set\nfaintest: batches of training"
        axes.text(0.03, 0.05, key, transform=axes.transAxes, fontsize="small", color="0.3")


PANELS = {"return": _draw_returns, "critic": _draw_critic, "cloning loss": _draw_losses}
"""What draws a run, by the panel's title."""


@dataclass(frozen=True)
class Config:
    """Draw results/ladder/ladder.png and print the budgets; there is nothing to choose."""


def main(config: Config) -> None:
    """See the config."""
    cells = cells_in()
    figure(cells).savefig(RESULTS / "ladder.png", dpi=150)
    print("\n".join(budget_lines(cells)))


if __name__ == "__main__":
    run_script(main, Config)
