"""The tables of the navigation report: the paper's, each number beside its own where units agree, and four more."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.envs.mazes import MAZES, PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_interval
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.studies.navigation.claims import paper_number
from vd4rl_pomdp.studies.navigation.grid import Condition, condition_of, paper_rows
from vd4rl_pomdp.studies.navigation.measures import Measure, held_out_loss, refitted_error
from vd4rl_pomdp.studies.navigation.methods import METHOD_NAMES, OBJECTIVES, REFERENCES
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, is_missing

_REFITTED = "held-out trajectories, probe refitted on frozen states"
PROTOCOLS = {
    "training averages, probe trained beside the model (the paper's way)": ("training", "online"),
    _REFITTED: ("held_out", "refit"),
}
"""How an error is measured: the split and the probe."""
_LOSS_PROTOCOLS = {
    "training averages (the paper's way)": ("training", ""),
    "held-out trajectories": ("held_out", ""),
}
_TITLES = {
    "state_error": "State estimation errors, K = 1 and 15",
    "position_error": "Position errors, K = 15",
    "velocity_error": "Velocity errors, K = 15",
    "action_loss": "Action prediction losses (nats x 100), K = 15",
    "self_prediction": "State estimation errors without and with self-prediction, K = 15",
    "exogenous": "State estimation errors with exogenous noise, K = 15",
    "exogenous_main": "State estimation errors with exogenous noise, two mazes (the main text's table)",
    "references": "References: untrained, trained on the true states, and MIK+A whose future holds a_{t+k-1}",
    "hidden": "Errors on steps that a curtain hides, K = 15",
    "by_k": "Action losses (nats x 100) by k, K = 15",
    "others": "State estimation errors of what no other table has",
}
_PAPER_TABLES = tuple(_TITLES)[:7]
MAIN_TEXT = ("no_curtain", "three_curtains")
"""Mazes of the tables in the paper's main text."""


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
        """95% t interval over seeds."""
        return mean_interval(self.numbers[:, None]) if len(self.numbers) else None


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


def make_tables(runs: list[NavigationRun]) -> list[Table]:
    """The paper's six tables (position and velocity are one of them), then four of our own."""
    tables = []
    for name in _PAPER_TABLES:
        for protocol, (split, probe) in (_LOSS_PROTOCOLS if name == "action_loss" else PROTOCOLS).items():
            for raw in (False,) if name == "action_loss" else (False, True):
                tables.append(_paper_table(name, protocol, split, probe, raw, runs))
    for make in (_references_table, _hidden_table):
        tables += [make(raw, runs) for raw in (False, True)]
    others = _others(runs)
    return [*tables, _by_k_table(runs), *(_others_table(others, raw, runs) for raw in (False, True) if others)]


def _mazes(runs: list[NavigationRun], raw: bool = False) -> tuple[str, ...]:
    """Columns of a table: the paper's mazes if any of them has runs (with raw numbers), and variants that have some."""
    trained = {run.condition.maze for run in runs if not raw or any(measure.is_raw for measure in run.values)}
    paper = trained & set(PAPER_MAZES)
    return tuple(maze for maze in MAZES if maze in trained or (paper and maze in PAPER_MAZES))


def _in_units(protocol: str, raw: bool) -> str:
    return f"{protocol}; {'raw units x 100, beside the paper' if raw else '% of a standard deviation'}"


def _paper_table(name: str, protocol: str, split: str, probe: str, raw: bool, runs: list[NavigationRun]) -> Table:
    mazes = tuple(maze for maze in _mazes(runs, raw) if name != "exogenous_main" or MAZES[maze].paper in MAIN_TEXT)
    rows = []
    for line in paper_rows():
        if line["table"] != name.removesuffix("_main"):
            continue
        component = line["component"] if name == "action_loss" else f"{line['component']}_error"
        measure = Measure(component, split, probe)
        options = "".join(f", {o}" for o in ("self-prediction",) if line["self_prediction"] == "Y")
        label = f"{line['objective']}, K={line['k_max']}{options}"
        shown = measure.raw() if raw else measure
        rows.append((label, [entry_of(condition_of(line, maze), shown, runs) for maze in mazes]))
    return Table(name, protocol if name == "action_loss" else _in_units(protocol, raw), mazes, rows)


def _references_table(raw: bool, runs: list[NavigationRun]) -> Table:
    """What the paper does not show: the floor, the ceilings, and the literal future."""
    mazes = _mazes(runs, raw)
    rows = []
    for method in REFERENCES:
        for component in ("state", "position", "velocity"):
            measure = _refitted(component, raw)
            rows.append(
                (f"{method}, {component}", [entry_of(Condition(maze, method), measure, runs) for maze in mazes])
            )
    literal = [Condition(maze, "mik+a", 1, literal_future=True) for maze in mazes]
    for name, measure in {"state error": _refitted("state", raw), "action loss": held_out_loss()}.items():
        rows.append(
            (f"MIK+A, literal future, K=1, {name}", [entry_of(condition, measure, runs) for condition in literal])
        )
    return Table("references", _in_units(_REFITTED, raw), mazes, rows)


def _hidden_table(raw: bool, runs: list[NavigationRun]) -> Table:
    """Errors on hidden steps alone."""
    mazes = tuple(maze for maze in _mazes(runs, raw) if MAZES[maze].curtains)
    rows = []
    for method in METHOD_NAMES:
        for component in ("position", "velocity"):
            measure = _refitted(component, raw, rows="hidden")
            rows.append(
                (f"{method}, {component}", [entry_of(Condition(maze, method), measure, runs) for maze in mazes])
            )
    return Table("hidden", _in_units(_REFITTED, raw), mazes, rows)


def _others(runs: list[NavigationRun]) -> list[Condition]:
    """Conditions, without their mazes, that neither the paper nor the references have."""
    told = [condition_of(line, "") for line in paper_rows()]
    told += [*(Condition("", method) for method in REFERENCES), Condition("", "mik+a", 1, literal_future=True)]
    return [found for found in dict.fromkeys(replace(run.condition, maze="") for run in runs) if found not in told]


def _others_table(others: list[Condition], raw: bool, runs: list[NavigationRun]) -> Table:
    """State errors of conditions that no other table has."""
    mazes, measure = _mazes(runs, raw), _refitted("state", raw)
    rows = [(one.short, [entry_of(replace(one, maze=maze), measure, runs) for maze in mazes]) for one in others]
    return Table("others", _in_units(_REFITTED, raw), mazes, rows)


def _refitted(component: str, raw: bool, rows: str = "all") -> Measure:
    measure = refitted_error(component, rows)
    return measure.raw() if raw else measure


def _by_k_table(runs: list[NavigationRun]) -> Table:
    """Action losses at a small, a middle and the greatest k."""
    mazes, rows = _mazes(runs), []
    for method in OBJECTIVES:
        for k in (1, 5, 15):
            entries = [entry_of(Condition(maze, method), held_out_loss(k), runs) for maze in mazes]
            rows.append((f"{method}, k={k}", entries))
    return Table("by_k", "held-out trajectories", mazes, rows)


def entry_of(condition: Condition, measure: Measure, runs: list[NavigationRun]) -> Entry:
    """One measure of a condition, as some runs have it."""
    numbers = [run.values[measure] for run in runs if run.condition == condition and measure in run.values]
    seeds = {run.seed for run in runs if run.condition.maze == condition.maze}
    return Entry(condition, measure, np.array(numbers), len(seeds), is_missing(condition, runs))


def table_sections(tables: list[Table]) -> Iterable[str]:
    """Lines of a page's part: every table under its title."""
    for name, variants in groupby(tables, lambda table: table.name):
        yield from (f"## {_TITLES[name]}", "")
        for table in variants:
            yield from _markdown(table)


def _markdown(table: Table) -> list[str]:
    """A table under its protocol; lines that neither a run nor the paper has a number for are left out."""
    if not table.lines():
        return [f"*{table.protocol}*: no run yet.", ""]
    lines = [f"*{table.protocol}*", "", "| | " + " | ".join(table.mazes) + " |", "|---|" + "---|" * len(table.mazes)]
    for label, entries in table.lines():
        lines.append(f"| {label} | {' | '.join(entry.text() for entry in entries)} |")
    return [*lines, ""]


def write_tables(tables: list[Table], path: Path) -> None:
    """Write every number of the tables as CSV."""
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
