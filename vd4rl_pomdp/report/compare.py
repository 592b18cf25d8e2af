"""Compares two sets of results: scores, differences, conditions in only one of them, and settings that differ."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pandas as pd
from rich.console import Console

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.text import one_line, write_text
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.figures import seeds_note, write_table
from vd4rl_pomdp.report.gates import verdicts
from vd4rl_pomdp.report.load import CONDITION, SETTING, Run, label, load_runs, setting
from vd4rl_pomdp.report.page import made_with
from vd4rl_pomdp.report.render import Columns, block, print_setting, render, texts, write_latex
from vd4rl_pomdp.report.tables import SCORE, mean_and_ends
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import certificates_of

NOT_INDEPENDENT = "No interval where a run is in both sets: they are not independent samples; compare disjoint sets."
FILE = "comparison"  # base name of its files, by which a comparison's folder is recognised
Conditions = dict[tuple, list[Run]]  # finished runs by the values of CONDITION


class SideBySide(NamedTuple):
    """Two sets of results side by side."""

    sides: list[Row]
    """Of each set its `path`, numbers of `finished` runs and of `others`, not compared, and what it was `made` with."""
    rows: list[Row]
    """One per condition: scores with intervals and n of both, difference with interval, number of runs `shared` by both
    sets (then no interval), differing settings, memory."""


def compare_results(one: Path, other: Path) -> SideBySide:
    """Compare the final scores of all finished runs at or below two paths, run folders or results folders.

    Conditions are those of a report of each set. They are matched by equal settings, whatever their names; then by
    name; then, if a method has a single variant in each set, by method.
    """
    (mine, first), (theirs, second) = _loaded(one), _loaded(other)
    runs = [run for side in (first, second) for seeds in side.values() for run in seeds]
    memory = verdicts(runs, certificates_of([run.result for run in runs], [one, other]))
    partners = _partners(first, second)
    rows = [_row(key, runs, second.get(partners.get(key, ()), [])) for key, runs in first.items()]
    rows += [_row(key, [], runs) for key, runs in second.items() if key not in partners.values()]
    rows = [row | {"memory": memory[tuple(row[name] for name in SETTING)]} for row in rows]
    return SideBySide([mine, theirs], sorted(rows, key=lambda row: [str(row[name]) for name in CONDITION]))


def _loaded(path: Path) -> tuple[Row, Conditions]:
    runs = [run for run in load_runs([path]) if run.stage == "finetune"]
    finished = [run for run in runs if run.evaluated]
    if not finished:
        raise UserError(f"{path}: holds no finished and evaluated run to compare; name one that does")
    counts = {"finished": len(finished), "others": len(runs) - len(finished)}
    return {"path": path, **counts, "made": made_with(finished)}, groups(finished, lambda run: run.of(CONDITION))


def _partners(first: Conditions, second: Conditions) -> dict[tuple, tuple]:
    """Match conditions: first set's key -> second set's key, where there is a partner."""
    settings = {_what_was_done(runs): key for key, runs in second.items()}
    done = {key: _what_was_done(runs) for key, runs in first.items()}
    found = {key: settings[what] for key, what in done.items() if what in settings}
    free = second.keys() - set(found.values())
    for key in first.keys() - found.keys():
        # A method with a single variant in each set, whatever its settings.
        alike, theirs = ([one for one in part if one[:-1] == key[:-1]] for part in (first, second))
        partner = key if key in second else theirs[0] if len(alike) == len(theirs) == 1 else None
        if partner in free:
            found[key] = partner
    return found


def _what_was_done(runs: list[Run]) -> tuple:
    """What a condition's runs computed, from their files only, since names depend on the other runs of a set."""
    labels = (value for name, value in runs[0].result.labels.items() if name != "seed")
    return *labels, frozenset(frozenset(run.settings.items()) for run in runs)


def _row(key: tuple, one: list[Run], other: list[Run]) -> Row:
    """A condition's row; None for what a set lacks."""
    row: Row = dict(zip(CONDITION, key, strict=True))
    scores = [stats.by_episode([[episode["score"] for episode in run.last] for run in runs]) for runs in (one, other)]
    for side, mine in zip("ab", scores, strict=True):
        nothing = dict.fromkeys((f"score_{side}", f"low_{side}", f"high_{side}"))
        row |= (mean_and_ends(mine, suffix=f"_{side}") if len(mine) else nothing) | {f"seeds_{side}": len(mine)}
    shared = len({_evaluated(run) for run in one} & {_evaluated(run) for run in other})
    row |= {"difference": None, "low": None, "high": None, "shared": shared, "settings": ""}
    if one and other:
        a, b = scores
        # The interval is of independent samples, and a run with itself is no pair of two measurements.
        row["low"], row["high"] = (None if shared else stats.difference_interval(b, a)) or (None, None)
        row |= {"difference": float(b.mean() - a.mean()), "settings": _differing(one, other)}
    return row


def _evaluated(run: Run) -> tuple:
    """What makes two finished runs one: what was computed, and the scores of its last evaluation."""
    return run.result.id, *(episode["score"] for episode in run.last)


def _differing(one: list[Run], other: list[Run]) -> str:
    """Settings whose values differ between both sets: "steps 20 → 60, views 4 → 1"."""
    found = {
        name: [" or ".join(sorted({run.settings.get(name, "unset") for run in runs})) for runs in (one, other)]
        for name in dict.fromkeys(name for run in (*one, *other) for name in run.settings)
    }
    return ", ".join(f"{name} {mine} → {theirs}" for name, (mine, theirs) in found.items() if mine != theirs)


_COLUMNS: Columns = {
    "setting": setting,
    "method": label,
    "settings, A → B": lambda row: (
        row["settings"] or "the same" if row["seeds_a"] and row["seeds_b"] else f"only in {'AB'[not row['seeds_a']]}"
    ),
    "A": ("score_a", "low_a", "high_a", 1),
    "B": ("score_b", "low_b", "high_b", 1),
    "B – A": ("difference", "low", "high", 1),
    "seeds": lambda row: (
        f"{row['seeds_a']} | {row['seeds_b']}" + (f", {row['shared']} in both" if row["shared"] else "")
    ),
}


def print_comparison(comparison: SideBySide) -> None:
    """Print the comparison, one table per setting, with differing settings under the method's name."""
    console = Console()
    for name, side in zip("AB", comparison.sides, strict=True):
        others = f", {side['others']} unfinished or diverged" if side["others"] else ""
        line = f"{name}: {side['path']}, {side['finished']} finished runs{others}"
        console.print(one_line(line), markup=False, highlight=False)
    shown = texts(pd.DataFrame(comparison.rows), _COLUMNS)
    method = shown["method"] + "\n  " + shown.pop("settings, A → B")
    for place, part in shown.assign(method=method).groupby("setting", sort=False):
        table = part.drop(columns="setting").replace(r" \[", "\n[", regex=True)
        print_setting(console, str(place), comparison.rows[part.index[0]]["memory"], table)
    if any(row["shared"] for row in comparison.rows):
        console.print(NOT_INDEPENDENT, markup=False, highlight=False)


def write_comparison(comparison: SideBySide, out: Path) -> Path:
    """Write the comparison as page, CSV and LaTeX into a folder of its own; returns the page."""
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    rows = pd.DataFrame(comparison.rows)
    shown, blocks = texts(rows, _COLUMNS), []
    for place, part in shown.groupby("setting", sort=False):
        note = seeds_note(rows.loc[part.index, ["seeds_a", "seeds_b"]].stack())
        note += f" Memory: {rows['memory'][part.index[0]]}."
        note += f" {NOT_INDEPENDENT}" if rows.loc[part.index, "shared"].any() else ""
        blocks.append(block(str(place), part.drop(columns="setting"), 2, note))
    write_table(out / f"{FILE}.csv", rows)
    write_latex(out / f"{FILE}.tex", shown, 3, f"{SCORE}. Mean over seeds, 95% t intervals over seeds and episodes.")
    page = render("compare.html", score=SCORE, sides=comparison.sides, tables=blocks, file=FILE)
    write_text(out / "index.html", page)
    return out / "index.html"
