"""The tables of the navigation report: the paper's, each number beside its own where units agree, and four more.

Their layout is one frame, with a line for every number that a table has a place for; the numbers are a group-by of the
frame of runs, merged into it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from vd4rl_pomdp.envs.mazes import MAZES, PAPER_MAZES
from vd4rl_pomdp.report.stats import mean_interval
from vd4rl_pomdp.runs.files import write_csv
from vd4rl_pomdp.studies.navigation.measures import (
    METHOD_NAMES,
    OBJECTIVES,
    RAW_PREFIX,
    REFERENCES,
    Condition,
    Measure,
    condition_of,
    held_out_loss,
    paper_number,
    paper_rows,
    refitted_error,
)
from vd4rl_pomdp.studies.navigation.runs import KEYS

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
_UNITS = {False: "% of a standard deviation", True: "raw units x 100, beside the paper"}
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
LITERAL = Condition("", "mik+a", 1, literal_future=True)
Line = tuple[str, str, str, Condition, Measure]
"""Of the layout: table, view, row, and what stands there."""


def make_tables(frame: pd.DataFrame) -> pd.DataFrame:
    """The paper's six tables (position and velocity are one of them), then four of our own: one line a number.

    Returns:
        `table`, `view` and `row` where the number stands, KEYS, `numbers` by seed, their `mean`, `low` and `high` (95%
        t interval), `seeds` and `of_seeds`, those with which the maze was trained under any condition; the `paper`'s
        number; and whether it is `missing`, see `is_missing`.
        Rows of a table for which neither a run nor the paper has a number are left out, and tables that no run has.
    """
    lines = list(_layout(frame))
    places = [(*line[:3], *line[3], *line[4]) for line in lines]
    cells = pd.DataFrame(places, columns=["table", "view", "row", *KEYS])
    trained = conditions_of(frame)
    cells["paper"] = [paper_number(condition, measure) for _, _, _, condition, measure in lines]
    cells["missing"] = [is_missing(condition, trained) for _, _, _, condition, _ in lines]
    groups = frame.groupby(KEYS)["value"].agg(numbers=np.array).reset_index()
    cells = cells.merge(groups, how="left", on=KEYS)
    cells["numbers"] = [found if isinstance(found, np.ndarray) else np.empty(0) for found in cells["numbers"]]
    cells["seeds"] = cells["numbers"].map(len)
    cells["of_seeds"] = cells["maze"].map(frame.groupby("maze")["seed"].nunique())
    cells["mean"] = [found.mean() if len(found) else None for found in cells["numbers"]]
    ends = [mean_interval(found[:, None]) if len(found) else None for found in cells["numbers"]]
    cells[["low", "high"]] = [end or (None, None) for end in ends]
    told = (cells["seeds"] > 0) | cells["paper"].notna()
    of_row = [cells["table"], cells["view"], cells["row"]]
    return cells[told.groupby(of_row).transform("any") & (cells["seeds"].groupby(of_row[:2]).transform("max") > 0)]


def conditions_of(frame: pd.DataFrame) -> set[Condition]:
    """The conditions that have runs."""
    return {Condition(*row) for row in frame[list(Condition._fields)].drop_duplicates().itertuples(index=False)}


def is_missing(condition: Condition, trained: set[Condition]) -> bool:
    """Whether a condition has no run, although its maze has runs and the same condition has some in another maze."""
    return (
        condition not in trained
        and any(other.maze == condition.maze for other in trained)
        and any(other[1:] == condition[1:] for other in trained)
    )


def _layout(frame: pd.DataFrame) -> Iterator[Line]:
    """What stands where in every table, table by table and row by row."""
    mazes = {raw: _mazes(frame, raw) for raw in (False, True)}
    for name in _PAPER_TABLES:
        for protocol, (split, probe) in (_LOSS_PROTOCOLS if name == "action_loss" else PROTOCOLS).items():
            for raw in (False,) if name == "action_loss" else (False, True):
                view = protocol if name == "action_loss" else f"{protocol}; {_UNITS[raw]}"
                yield from _paper_table(name, view, Measure("", split, probe), mazes[raw], raw)
    for raw in (False, True):
        view = f"{_REFITTED}; {_UNITS[raw]}"
        for row, condition, measure in _references():
            yield from _row("references", view, row, condition, measure.raw() if raw else measure, mazes[raw])
    for raw in (False, True):
        view, hiding = f"{_REFITTED}; {_UNITS[raw]}", [maze for maze in mazes[raw] if MAZES[maze].curtains]
        for method in METHOD_NAMES:
            for component in ("position", "velocity"):
                measure = refitted_error(component, "hidden")
                shown = measure.raw() if raw else measure
                yield from _row("hidden", view, f"{method}, {component}", Condition("", method), shown, hiding)
    for method in OBJECTIVES:
        for k in (1, 5, 15):
            where = "by_k", "held-out trajectories", f"{method}, k={k}"
            yield from _row(*where, Condition("", method), held_out_loss(k), mazes[False])
    others = _others(frame)
    for raw in (False, True):
        measure = refitted_error("state").raw() if raw else refitted_error("state")
        for condition in others:
            view = f"{_REFITTED}; {_UNITS[raw]}"
            yield from _row("others", view, condition.short, condition, measure, mazes[raw])


def _row(table: str, view: str, row: str, condition: Condition, measure: Measure, mazes: Iterable[str]) -> list[Line]:
    return [(table, view, row, condition._replace(maze=maze), measure) for maze in mazes]


def _mazes(frame: pd.DataFrame, raw: bool) -> list[str]:
    """Columns of a table: the paper's mazes if any of them has runs (with raw numbers), and variants that have some."""
    told = frame[frame["measure"].str.startswith(RAW_PREFIX)] if raw else frame
    trained = set(told["maze"])
    paper = trained & set(PAPER_MAZES)
    return [maze for maze in MAZES if maze in trained or (paper and maze in PAPER_MAZES)]


def _paper_table(name: str, view: str, measure: Measure, mazes: list[str], raw: bool) -> Iterator[Line]:
    """One of the paper's tables; `measure` lacks what is measured."""
    shown = [maze for maze in mazes if name != "exogenous_main" or MAZES[maze].paper in MAIN_TEXT]
    for line in paper_rows():
        if line["table"] == name.removesuffix("_main"):
            what = line["component"] if name == "action_loss" else f"{line['component']}_error"
            options = ", self-prediction" if line["self_prediction"] == "Y" else ""
            label, found = f"{line['objective']}, K={line['k_max']}{options}", measure._replace(measure=what)
            yield from _row(name, view, label, condition_of(line, ""), found.raw() if raw else found, shown)


def _references() -> Iterator[tuple[str, Condition, Measure]]:
    """What the paper does not show: the floor, the ceilings, and the literal future."""
    for method in REFERENCES:
        for component in ("state", "position", "velocity"):
            yield f"{method}, {component}", Condition("", method), refitted_error(component)
    yield "MIK+A, literal future, K=1, state error", LITERAL, refitted_error("state")
    yield "MIK+A, literal future, K=1, action loss", LITERAL, held_out_loss()


def _others(frame: pd.DataFrame) -> list[Condition]:
    """Conditions, without their mazes, that neither the paper nor the references have."""
    told = {condition_of(line, "") for line in paper_rows()}
    told |= {*(Condition("", method) for method in REFERENCES), LITERAL}
    found = frame[list(Condition._fields)].assign(maze="").drop_duplicates().itertuples(index=False)
    return [condition for condition in (Condition(*row) for row in found) if condition not in told]


def cell_text(cell: pd.Series) -> str:
    """Mean, interval, seeds, and the paper's number in brackets; "no run" for one that is missing."""
    paper = "" if pd.isna(cell["paper"]) else f"({cell['paper']:.1f})"
    if not cell["seeds"]:
        return f"no run {paper}".rstrip() if cell["missing"] else paper
    spread = "" if pd.isna(cell["low"]) else f" [{cell['low']:.1f}, {cell['high']:.1f}]"
    seeds = f"n={cell['seeds']}" + (f" of {cell['of_seeds']:.0f}" if cell["seeds"] < cell["of_seeds"] else "")
    return f"**{cell['mean']:.1f}**{spread} {seeds} {paper}".rstrip()


def table_sections(cells: pd.DataFrame) -> Iterator[str]:
    """Lines of a page's part: every table under its title, a column for each maze."""
    texts = cells.assign(text=cells.apply(cell_text, axis=1))
    for name, title in _TITLES.items():
        mine = texts[texts["table"] == name]
        if mine.empty and name == "others":
            continue
        yield from (f"## {title}", "", *([] if len(mine) else ["No run yet.", ""]))
        for view, table in mine.groupby("view", sort=False):
            mazes, rows = table["maze"].unique(), table["row"].unique()
            wide = table.pivot(index="row", columns="maze", values="text").loc[rows, mazes]
            yield from (f"*{view}*", "", "| | " + " | ".join(mazes) + " |", "|---|" + "---|" * len(mazes))
            yield from (f"| {label} | {' | '.join(row)} |" for label, row in zip(rows, wide.to_numpy(), strict=True))
            yield ""


def write_tables(cells: pd.DataFrame, path: Path) -> None:
    """Write every number of the tables as CSV."""
    shown = cells[(cells["seeds"] > 0) | cells["missing"]].copy()
    for name in ("mean", "low", "high"):
        shown[name] = ["" if pd.isna(value) else f"{value:.4g}" for value in shown[name]]
    shown["paper"] = ["" if pd.isna(value) else value for value in shown["paper"]]
    columns = ["table", "view", "row", "maze", "mean", "low", "high", "seeds", "paper"]
    write_csv(path, columns, shown[columns].to_dict("records"))
