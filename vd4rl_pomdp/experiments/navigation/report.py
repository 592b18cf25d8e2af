"""The navigation report: the paper's tables from raw rows, each number beside the paper's, and what they say.

OUT/README.md     tables, verdicts, figures, and the command of every condition
OUT/rows.csv, runs.csv, trajectories/     raw numbers; `navigation report OUT` makes everything again from them
OUT/tables.csv    every number: mean, interval, seeds, the paper's number
OUT/figures/      accuracy.png, trajectories.png, observations.png
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.experiments.navigation import figures
from vd4rl_pomdp.experiments.navigation.claims import paper_number, verdict_lines
from vd4rl_pomdp.experiments.navigation.grid import Condition, condition_of, paper_rows
from vd4rl_pomdp.experiments.navigation.runs import (
    ROWS,
    NavigationRun,
    is_missing,
    load_runs,
    save_runs,
    unfinished_runs,
)
from vd4rl_pomdp.mazes import MAZES
from vd4rl_pomdp.navigation.config import PRESETS
from vd4rl_pomdp.navigation.measures import Measure, held_out_loss, refitted_error
from vd4rl_pomdp.navigation.methods import METHOD_NAMES, OBJECTIVES, REFERENCES, UNTRAINED
from vd4rl_pomdp.report.stats import bootstrap_interval, mean
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.text import code, code_block, markdown, write_text

PROTOCOLS = {
    "training averages, probe trained beside the model (the paper's way)": ("training", "online"),
    "held-out trajectories, probe refitted on frozen states": ("held_out", "refit"),
}
"""How an error is measured: the split and the probe."""
_LOSS_PROTOCOLS = {
    "training averages (the paper's way)": ("training", ""),
    "held-out trajectories": ("held_out", ""),
}
_TITLES = {
    "state_error": "State estimation errors (%), K = 1 and 15",
    "position_error": "Position errors (%), K = 15",
    "velocity_error": "Velocity errors (%), K = 15",
    "action_loss": "Action prediction losses (nats x 100), K = 15",
    "self_prediction": "State estimation errors (%) without and with self-prediction, K = 15",
    "exogenous": "State estimation errors (%) with exogenous noise, K = 15",
    "exogenous_main": "State estimation errors (%) with exogenous noise, two mazes (the main text's table)",
}
_MAIN_TEXT = ("no_curtain", "three_curtains")


@dataclass(frozen=True)
class Entry:
    """One number of a table."""

    condition: Condition
    measure: Measure
    numbers: np.ndarray
    """(n,) one for each seed."""
    of_seeds: int
    """Seeds that the maze was trained with, under any condition."""
    missing: bool
    """Whether its maze has runs, and its condition has some in another maze, but it has none itself."""

    @property
    def paper(self) -> float | None:
        """The paper's number."""
        return paper_number(self.condition, self.measure)

    def text(self) -> str:
        """Mean, interval, seeds, and the paper's number in brackets; "no run" for one that is missing."""
        paper = "" if self.paper is None else f"({self.paper:.1f})"
        if not len(self.numbers):
            return f"no run {paper}".rstrip() if self.missing else paper
        interval = self.interval()
        spread = "" if interval is None else f" [{interval[0]:.1f}, {interval[1]:.1f}]"
        seeds = f"n={len(self.numbers)}" + (f" of {self.of_seeds}" if len(self.numbers) < self.of_seeds else "")
        return f"**{self.numbers.mean():.1f}**{spread} {seeds} {paper}".rstrip()

    def interval(self) -> tuple[float, float] | None:
        """Bootstrap interval over seeds."""
        if not len(self.numbers):
            return None
        return bootstrap_interval([self.numbers], mean, np.random.default_rng(0))


@dataclass(frozen=True)
class Table:
    """Rows of entries, one column a maze."""

    name: str
    protocol: str
    mazes: tuple[str, ...]
    rows: list[tuple[str, list[Entry]]]

    def lines(self) -> list[tuple[str, list[Entry]]]:
        """Rows with a number of a run or of the paper; no rows at all if no run has a number."""
        if not any(len(entry.numbers) for _, entries in self.rows for entry in entries):
            return []
        return [row for row in self.rows if any(len(e.numbers) or e.paper is not None for e in row[1])]


Samples = Callable[[], Mapping[str, np.ndarray]]
"""Draws sample observations: (n, 3, H, W) uint8 by name."""


def write_report(sources: Sequence[Path], out: Path, samples: Samples | None = None) -> Path:
    """Write the report of all runs in `sources` to `out`; returns the page.

    Args:
        sources: run folders, folders of them, or a folder that this function wrote.
        out: where to.
        samples: draws the sample observations, which needs OpenGL; None leaves them out.
    """
    refuse_foreign(out, "navigation report", ROWS)
    runs, unfinished = load_runs(sources), unfinished_runs(sources)
    save_runs(runs, out)
    (out / "figures").mkdir(exist_ok=True)
    figures.accuracy_bars(runs, refitted_error("state"), out / "figures" / "accuracy.png")
    drawn = figures.trajectories(runs, out / "figures" / "trajectories.png")
    if samples is not None:
        figures.sample_observations(samples(), out / "figures" / "observations.png")
    tables = make_tables(runs)
    _write_tables(tables, out / "tables.csv")
    page = out / "README.md"
    write_text(page, "\n".join(_page(runs, unfinished, tables, drawn, samples is not None)) + "\n")
    return page


def make_tables(runs: list[NavigationRun]) -> list[Table]:
    """The paper's six tables (position and velocity are one of them), then three of our own."""
    tables = []
    for name in _TITLES:
        for protocol, (split, probe) in (_LOSS_PROTOCOLS if name == "action_loss" else PROTOCOLS).items():
            tables.append(_paper_table(name, protocol, split, probe, runs))
    return [*tables, _references_table(runs), _hidden_table(runs), _by_k_table(runs)]


def _paper_table(name: str, protocol: str, split: str, probe: str, runs: list[NavigationRun]) -> Table:
    mazes = _MAIN_TEXT if name == "exogenous_main" else tuple(MAZES)
    rows = []
    for line in paper_rows():
        if line["table"] != name.removesuffix("_main"):
            continue
        component = line["component"] if name == "action_loss" else f"{line['component']}_error"
        measure = Measure(component, split, probe)
        options = "".join(f", {o}" for o in ("self-prediction",) if line["self_prediction"] == "Y")
        label = f"{line['objective']}, K={line['k_max']}{options}"
        rows.append((label, [_entry(condition_of(line, maze), measure, runs) for maze in mazes]))
    return Table(name, protocol, mazes, rows)


def _references_table(runs: list[NavigationRun]) -> Table:
    """What the paper does not show: the floor, the ceilings, and the literal future."""
    mazes = tuple(MAZES)
    rows = []
    for method in REFERENCES:
        for component in ("state", "position", "velocity"):
            measure = refitted_error(component)
            rows.append((f"{method}, {component}", [_entry(Condition(maze, method), measure, runs) for maze in mazes]))
    literal = [Condition(maze, "mik+a", 1, literal_future=True) for maze in mazes]
    for name, measure in {"state error": refitted_error("state"), "action loss": held_out_loss()}.items():
        rows.append(
            (f"MIK+A, literal future, K=1, {name}", [_entry(condition, measure, runs) for condition in literal])
        )
    return Table("references", "held-out trajectories, probe refitted on frozen states", mazes, rows)


def _hidden_table(runs: list[NavigationRun]) -> Table:
    """Errors on hidden steps alone."""
    mazes = tuple(maze for maze, spec in MAZES.items() if spec.curtains)
    rows = []
    for method in METHOD_NAMES:
        for component in ("position", "velocity"):
            measure = refitted_error(component, rows="hidden")
            rows.append((f"{method}, {component}", [_entry(Condition(maze, method), measure, runs) for maze in mazes]))
    return Table("hidden", "held-out trajectories, probe refitted on frozen states", mazes, rows)


def _by_k_table(runs: list[NavigationRun]) -> Table:
    """Action losses at a small, a middle and the greatest k."""
    rows = []
    for method in OBJECTIVES:
        for k in (1, 5, 15):
            rows.append(
                (f"{method}, k={k}", [_entry(Condition(maze, method), held_out_loss(k), runs) for maze in MAZES])
            )
    return Table("by_k", "held-out trajectories", tuple(MAZES), rows)


def _entry(condition: Condition, measure: Measure, runs: list[NavigationRun]) -> Entry:
    numbers = [run.values[measure] for run in runs if run.condition == condition and measure in run.values]
    seeds = {run.seed for run in runs if run.condition.maze == condition.maze}
    return Entry(condition, measure, np.array(numbers), len(seeds), is_missing(condition, runs))


_OWN_TITLES = {
    "references": "References: untrained, trained on the true states, and MIK+A whose future holds a_{t+k-1}",
    "hidden": "Errors (%) on steps that a curtain hides, K = 15",
    "by_k": "Action losses (nats x 100) by k, K = 15",
}


def _page(
    runs: list[NavigationRun], unfinished: list[tuple[Path, str]], tables: list[Table], drawn: bool, pictures: bool
) -> list[str]:
    preset, seeds = runs[0].preset, sorted({run.seed for run in runs})
    lines = ["# Navigation: what the objectives know of the state", ""]
    lines += [
        f"Runs: {len(runs)}. Preset: {code(preset)}. Seeds: {', '.join(map(str, seeds))}. {_budget(runs)}",
        "",
        *(f"Unfinished, in no table: {code(str(path))} {state}.  " for path, state in unfinished),
        *([""] if unfinished else []),
        "A cell of a table reads: **mean over seeds** [95% bootstrap interval] n=seeds (the paper's number).",
        'Intervals of few seeds are too narrow. Missing: "n=1 of 3" where other cells of the maze have three seeds,',
        '"no run" where other cells of the maze, and other mazes of the row, have one.',
        "",
        "![Accuracy of every objective](figures/accuracy.png)",
        "",
        "Bars: held-out trajectories, probe refitted on frozen states. The paper's marks are training averages.",
        "",
        *verdict_lines(runs),
    ]
    lines += ["![True and estimated trajectories](figures/trajectories.png)", ""] if drawn else []
    lines += ["![Sample observations](figures/observations.png)", ""] if pictures else []
    for name, variants in groupby(tables, lambda table: table.name):
        lines += [f"## {_TITLES.get(name) or _OWN_TITLES[name]}", ""]
        for table in variants:
            lines += _markdown(table)
    return lines + _commands(runs)


def _budget(runs: list[NavigationRun]) -> str:
    """What the runs cost, and where."""
    trained = [run for run in runs if run.condition.method != UNTRAINED]
    steps = " or ".join(f"{count:,}" for count in sorted({int(run.facts["steps"]) for run in trained}))
    minutes = [float(run.facts["seconds"]) / 60 for run in trained]
    machines = markdown("; ".join(sorted({run.facts["gpu"] or f"{run.facts['processor']}, no GPU" for run in runs})))
    data = PRESETS[runs[0].preset]
    return (
        f"Budget: {steps} gradient steps on {data.trajectories * data.trajectory_rows:,} samples, "
        f"{min(minutes, default=0):.0f} to {max(minutes, default=0):.0f} minutes a run ({machines}). "
        "The paper's: 200,000 steps on 500,000 samples."
    )


def _markdown(table: Table) -> list[str]:
    """A table under its protocol; lines that neither a run nor the paper has a number for are left out."""
    if not table.lines():
        return [f"*{table.protocol}*: no run yet.", ""]
    lines = [f"*{table.protocol}*", "", "| | " + " | ".join(table.mazes) + " |", "|---|" + "---|" * len(table.mazes)]
    for label, entries in table.lines():
        lines.append(f"| {label} | {' | '.join(entry.text() for entry in entries)} |")
    return [*lines, ""]


def _commands(runs: list[NavigationRun]) -> list[str]:
    """The command of every run behind the tables."""
    lines = [
        "## Commands",
        "",
        "Each line computes one run; `navigation collect` makes its data. Seconds are wall-clock.",
        "`vd4rl-pomdp sweep run navigation --out runs/navigation --dry-run` prints those of every cell.",
    ]
    commands = []
    for maze in dict.fromkeys(run.condition.maze for run in runs):
        collect = f"vd4rl-pomdp navigation collect --preset {runs[0].preset} --maze {maze} --out data/{maze}"
        commands.append(collect)
    for run in runs:
        commands.append(f"{run.facts['command']}  # {float(run.facts['seconds']):.0f} s")
    return [*lines, "", *code_block(commands, "bash")]


def _write_tables(tables: list[Table], path: Path) -> None:
    names = ["table", "view", "row", "maze", "mean", "low", "high", "seeds", "paper"]
    rows = (
        _csv_row(table, label, maze, entry)
        for table in tables
        for label, entries in table.lines()
        for maze, entry in zip(table.mazes, entries, strict=True)
        if len(entry.numbers) or entry.missing
    )
    write_csv(path, names, rows)


def _csv_row(table: Table, label: str, maze: str, entry: Entry) -> dict[str, Any]:
    low, high = entry.interval() or ("", "")
    return {
        "table": table.name,
        "view": table.protocol,
        "row": label,
        "maze": maze,
        "mean": f"{entry.numbers.mean():.4g}" if len(entry.numbers) else "",
        "low": low if low == "" else f"{low:.4g}",
        "high": high if high == "" else f"{high:.4g}",
        "seeds": len(entry.numbers),
        "paper": "" if entry.paper is None else entry.paper,
    }
