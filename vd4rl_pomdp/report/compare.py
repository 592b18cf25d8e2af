"""Two result sets side by side: scores, differences, what only one of them has, and settings that are not the same."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table as TerminalTable
from rich.text import Text

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.text import write_text
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.facts import commits, machines
from vd4rl_pomdp.report.figures import seeds_note
from vd4rl_pomdp.report.layout import Line, ShownTable, interval, with_interval, write_latex
from vd4rl_pomdp.report.load import CONDITION, LoadedRun, load_runs
from vd4rl_pomdp.report.present import by_setting
from vd4rl_pomdp.report.tables import SCORE, SCORES_NOTE, evaluations, final_episodes, grouped, label, mean_and_ends
from vd4rl_pomdp.report.templates import render
from vd4rl_pomdp.runs.files import Row, write_csv
from vd4rl_pomdp.runs.outputs import refuse_foreign

FILE = "comparison"
"""Its files' name, which tells a comparison's folder."""
Conditions = dict[tuple, list[LoadedRun]]
"""Finished runs by the values of CONDITION."""
_KEY = CONDITION[:-1]
"""What two conditions share, however their variants are called."""
_COLUMNS = ("method", "settings, A → B", "A", "B", "B – A", "95% interval", "seeds")
_WORDS = 2
"""Columns that hold words."""


class Side(NamedTuple):
    """One of the two result sets."""

    path: Path
    finished: int
    """Runs with scores."""
    others: int
    """Unfinished and diverged runs, of which no score is compared."""
    commits: str
    machines: str


class SideBySide(NamedTuple):
    """Two result sets side by side."""

    sides: tuple[Side, Side]
    rows: list[Row]
    """One a condition: scores with intervals and n of both, difference with interval, settings that differ."""


def compare_results(one: Path, other: Path) -> SideBySide:
    """Compare the final scores of all finished runs at or below two paths, run folders or results folders.

    Conditions are those of a report of each set. Those of equal settings are compared, whatever a report of their own
    set calls them; then those of the same name; then a method that has a single variant in either set, whatever its
    settings.

    Raises:
        UserError: a path holds no evaluated run, or a file is damaged.
    """
    runs = [_loaded(path) for path in (one, other)]
    first, second = map(_conditions, runs)
    partners = _partners(first, second)
    pairs: list[tuple[tuple | None, tuple | None]] = [(mine, partners.get(mine)) for mine in first]
    pairs += [(None, theirs) for theirs in second if theirs not in partners.values()]
    rows = [_row(first.get(mine or ()), second.get(theirs or ()), mine or theirs or ()) for mine, theirs in pairs]
    sides = _side(one, runs[0]), _side(other, runs[1])
    return SideBySide(sides, sorted(rows, key=lambda row: [str(row[name]) for name in CONDITION]))


def _loaded(path: Path) -> list[LoadedRun]:
    runs = [run for run in load_runs([path]) if run.stage == "finetune"]
    if not any(run.evaluated for run in runs):
        raise UserError(f"{path}: holds no finished and evaluated run to compare")
    return runs


def _conditions(runs: list[LoadedRun]) -> Conditions:
    finished = [run.named | {"run": run} for run in runs if run.evaluated]
    return {key: [row["run"] for row in members] for key, members in grouped(finished, CONDITION)}


def _partners(first: Conditions, second: Conditions) -> dict[tuple, tuple]:
    """By condition of the first set, that of the second which it is compared with, if there is one."""
    settings = {_what_was_done(runs): theirs for theirs, runs in second.items()}
    equal = {mine: _what_was_done(runs) for mine, runs in first.items()}
    found = {mine: settings[done] for mine, done in equal.items() if done in settings}
    free = second.keys() - set(found.values())
    named = {mine: _of_like_name(mine, first, second) for mine in first if mine not in found}
    return found | {mine: theirs for mine, theirs in named.items() if theirs in free}


def _of_like_name(mine: tuple, first: Conditions, second: Conditions) -> tuple | None:
    """The condition of the second set that is called as one of the first; of a lone variant the other's; or nothing."""
    if mine in second:
        return mine
    alike, theirs = ([key for key in part if key[: len(_KEY)] == mine[: len(_KEY)]] for part in (first, second))
    return theirs[0] if len(alike) == len(theirs) == 1 else None


def _what_was_done(runs: list[LoadedRun]) -> tuple:
    """What a condition's runs computed on what, as their files have it: not by names that depend on other runs."""
    labels = (value for name, value in runs[0].result.labels.items() if name != "seed")
    settings = {frozenset(run.settings.items()) for run in runs}
    return *labels, frozenset(settings)


def _row(one: list[LoadedRun] | None, other: list[LoadedRun] | None, key: tuple) -> Row:
    """A condition's row; what a set does not have is None."""
    row: Row = dict(zip(CONDITION, key, strict=True))
    for side, runs in zip("ab", (one, other), strict=True):
        row |= _score(side, None if runs is None else final_episodes(evaluations(runs)))
    found = _difference(one, other) if one and other else (None, None, None)
    row |= dict(zip(("difference", "low", "high"), found, strict=True))
    return row | {"settings": _differing(one, other) if one and other else ""}


def _difference(one: list[LoadedRun], other: list[LoadedRun]) -> tuple[float, float | None, float | None]:
    """The second's mean score over the first's, with its interval; none where both are the same runs."""
    first, second = (final_episodes(evaluations(runs)) for runs in (one, other))
    same = {run.result.id for run in one} == {run.result.id for run in other} and np.array_equal(first, second)
    ends = None if same else stats.difference_interval(second, first)
    return float(second.mean() - first.mean()), *(ends or (None, None))


def _score(side: str, scores: np.ndarray | None) -> Row:
    values = (None, None, None, 0) if scores is None else (*mean_and_ends(scores), len(scores))
    return dict(zip((f"{name}_{side}" for name in ("score", "low", "high", "seeds")), values, strict=True))


def _differing(one: list[LoadedRun], other: list[LoadedRun]) -> str:
    """Settings whose values are not the same in both sets: "steps 20 → 60, views 4 → 1"."""
    names = dict.fromkeys(name for run in (*one, *other) for name in run.settings)
    told = []
    for name in names:
        mine, theirs = (sorted({run.settings.get(name, "unset") for run in runs}) for runs in (one, other))
        if mine != theirs:
            told.append(f"{name} {' or '.join(mine)} → {' or '.join(theirs)}")
    return ", ".join(told)


def _side(path: Path, runs: list[LoadedRun]) -> Side:
    finished = [run for run in runs if run.evaluated]
    return Side(path, len(finished), len(runs) - len(finished), commits(finished), machines(finished))


def tables(comparison: SideBySide) -> list[ShownTable]:
    """The comparison as the page shows it, one table a setting."""
    return [
        ShownTable(name, _COLUMNS, [Line(_cells(row)) for row in members], _WORDS, _note(members))
        for name, members in by_setting(comparison.rows)
    ]


def _note(rows: list[Row]) -> str:
    return seeds_note([{"seeds": row[name]} for row in rows for name in ("seeds_a", "seeds_b")])


def _cells(row: Row) -> tuple[str, ...]:
    scores = (with_interval(row[f"score_{s}"], row[f"low_{s}"], row[f"high_{s}"]) for s in "ab")
    difference = "–" if row["difference"] is None else f"{row['difference']:+.1f}"
    if row["difference"] is None:
        told = f"only in {'B' if row['score_a'] is None else 'A'}"
    else:
        told = row["settings"] or "the same"
    seeds = f"{row['seeds_a']} | {row['seeds_b']}"
    return label(row), told, *scores, difference, interval(row["low"], row["high"]), seeds


def print_comparison(comparison: SideBySide, console: Console | None = None) -> None:
    """The comparison on the terminal, one table a setting."""
    console = console or Console()
    for name, side in zip("AB", comparison.sides, strict=True):
        others = f", {side.others} unfinished or diverged" if side.others else ""
        console.print(f"{name}: {side.path}, {side.finished} finished runs{others}", markup=False, highlight=False)
    for table in tables(comparison):
        console.print(_terminal(table))


def _terminal(table: ShownTable) -> TerminalTable:
    """Narrow enough for 80 columns: settings stand under the method's label, intervals under their numbers."""
    shown = TerminalTable(title=Text(table.title), title_justify="left")
    for place, name in enumerate(_stacked(table.columns)):
        shown.add_column(name, overflow="fold", justify="right" if place else "left", no_wrap=place > 0)
    for line in table.lines:
        shown.add_row(*map(Text, _stacked(line.cells)))
    return shown


def _stacked(cells: Sequence[str]) -> tuple[str, ...]:
    name, told, *scores, difference, between, seeds = cells
    apart = f"{difference}\n{between}".removesuffix(f"\n{interval(None, None)}")
    return f"{name}\n  {told}", *(score.replace(" [", "\n[") for score in scores), apart, seeds


def check_out(out: Path) -> None:
    """Raise UserError for a folder that holds anything but an earlier comparison."""
    refuse_foreign(out, "comparison", f"{FILE}.csv")


def write_comparison(comparison: SideBySide, out: Path) -> Path:
    """Write the comparison as page, CSV and LaTeX into a folder that `check_out` accepts; returns the page."""
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    shown = tables(comparison)
    write_csv(out / f"{FILE}.csv", list(comparison.rows[0]), comparison.rows)
    write_latex(out / f"{FILE}.tex", shown, SCORES_NOTE)
    page = render("compare.html", score=SCORE, sides=comparison.sides, tables=shown, file=FILE)
    write_text(out / "index.html", page)
    return out / "index.html"
