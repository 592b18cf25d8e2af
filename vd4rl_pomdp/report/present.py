"""Numbers of a report's tables as the texts that its page and its LaTeX files show."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.claims import tally
from vd4rl_pomdp.report.figures import seeds_note
from vd4rl_pomdp.report.gaps import MISSING
from vd4rl_pomdp.report.grouping import groups
from vd4rl_pomdp.report.layout import Line, ShownTable, interval, number, with_interval
from vd4rl_pomdp.report.load import PROBES
from vd4rl_pomdp.report.measures import COSTS
from vd4rl_pomdp.report.overall import AGGREGATES
from vd4rl_pomdp.report.tables import TOLD_STATES, grouped, label, setting, with_algorithm
from vd4rl_pomdp.runs.files import Row

WIDEST = 6
"""Methods side by side in a matrix, at most: the others are put below."""


def gates(rows: list[Row]) -> list[ShownTable]:
    """What has to hold before methods are ranked."""
    columns = ("setting", "verdict", "data's return", "state", "acro, none", "best", "best – random")
    lines = []
    for row in rows:
        shares = (number(row[name], 2) for name in ("state_share", "acro_share", "best_share"))
        above = with_interval(row["above_random"], row["low"], row["high"], 0)
        lines.append(Line((with_algorithm(row), row["verdict"], number(row["data_return"], 0), *shares, above)))
    return [ShownTable("", columns, lines, words=2)]


def claims(rows: list[Row]) -> list[ShownTable]:
    """What becomes of the paper's claims, one table a claim."""
    columns = ("setting", "verdict", "left", "right", "difference", "played clean")
    return [
        ShownTable(claim, columns, list(map(_claim_line, members)), words=4, note=tally(members))
        for (claim,), members in grouped(rows, ("claim",))
    ]


def _claim_line(row: Row) -> Line:
    sides = (f"{row[side]}: {row[f'{side}_return']:.0f} (n = {row[f'{side}_seeds']})" for side in ("left", "right"))
    differences = (
        with_interval(row[f"{prefix}difference"], row[f"{prefix}low"], row[f"{prefix}high"], 0)
        for prefix in ("", "clean_")
    )
    return Line((setting(row), row["verdict"] or "–", *sides, *differences))


def scores(rows: list[Row]) -> list[ShownTable]:
    """Final and best scores, one table a setting."""
    columns = (
        *("method", "last evaluation", "95% interval", "at update"),
        *("best evaluation", "95% interval", "at update", "seeds", "episodes"),
    )
    return [_counted(name, columns, _score_line, members) for name, members in by_setting(rows)]


def _score_line(row: Row) -> Line:
    if row["score"] is None:
        return Line((label(row),), row["missing"])
    name = f"{label(row)} ({row['missing']})" if row["missing"] else label(row)
    last, best = (
        (number(row[f"{p}score"]), interval(row[f"{p}low"], row[f"{p}high"]), f"{row[f'{p}step']:,}")
        for p in ("", "best_")
    )
    return Line((name, *last, *best, _count(row["seeds"]), str(row["episodes"])))


def _count(seeds: int) -> str:
    return f"{seeds}†" if seeds < stats.FEW_SEEDS else str(seeds)


def aggregates(rows: list[Row]) -> list[ShownTable]:
    """Statistics over tasks, one table a corruption."""
    columns = ("method", "IQM", "median", "mean", "optimality gap", "tasks", "seeds")
    return [
        _counted(corruption, columns, _aggregate_line, members)
        for (corruption,), members in grouped(rows, ("corruption",))
    ]


def _aggregate_line(row: Row) -> Line:
    if row["iqm"] is None:
        return Line((label(row),), MISSING)
    found = (with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"]) for name in AGGREGATES)
    tasks = str(row["tasks"]) if row["tasks"] == row["of_tasks"] else f"{row['tasks']} of {row['of_tasks']}"
    return Line((label(row), *found, tasks, _count(row["seeds"])))


def improvements(rows: list[Row]) -> list[ShownTable]:
    """Probabilities of improvement as matrices, one or more a corruption: the row's method beats the column's."""
    tables = []
    for (corruption,), members in grouped(rows, ("corruption",)):
        names = list(dict.fromkeys(row["method"] for row in members))
        cells = {(row["method"], row["other"]): _chance(row) for row in members}
        parts = ceil(len(names) / WIDEST)
        for part in range(parts):
            others = names[part * len(names) // parts : (part + 1) * len(names) // parts]
            lines = [
                Line((name, *(cells.get((name, other), _nothing(name, other)) for other in others))) for name in names
            ]
            tables.append(ShownTable(corruption, ("row beats column", *others), lines, note=seeds_note(members)))
    return tables


def _nothing(name: str, other: str) -> str:
    return "" if name == other else "no common task"


def _chance(row: Row) -> str:
    """A probability with its interval, or the count of wins where one seed tells no probability."""
    if row["probability"] is None:
        return f"{row['wins']:g} of {row['pairs']}"
    few = "†" if row["seeds"] < stats.FEW_SEEDS else ""
    return with_interval(row["probability"], row["low"], row["high"], 2) + few


def representations(rows: list[Row]) -> list[ShownTable]:
    """Encoders' measures beside returns, one table a setting."""
    columns = ("method", "action loss", "pose, %", "velocity, %", "return", "seeds")
    return [_counted(name, columns, _measure_line, members, _told_note(members)) for name, members in by_setting(rows)]


def _told_note(rows: list[Row]) -> str:
    """What the probes of methods that regress the states are not."""
    told = [row["method"] for row in rows if row["method"] in TOLD_STATES]
    names = " and ".join(dict.fromkeys(told))
    return f" {names}: trained on the states of all episodes, those that the probe holds out, too." if told else ""


def _measure_line(row: Row) -> Line:
    if not row["seeds"]:
        return Line((label(row),), row["missing"])
    probes = (number(row[name]) for name in PROBES)
    return Line((label(row), number(row["action_loss"], 3), *probes, number(row["return"], 0), str(row["seeds"])))


def costs(rows: list[Row]) -> list[ShownTable]:
    """What both stages cost, by method."""
    columns = ("method", "machines", "pretraining, s", "fine-tuning, s", "runs")
    return [ShownTable("", columns, list(map(_cost_line, rows)), words=2, note=seeds_note(rows, "runs", "run"))]


def _cost_line(row: Row) -> Line:
    spans = []
    for name in COSTS:
        low, high = row[f"{name}_min"], row[f"{name}_max"]
        spans.append(number(row[name], 0) + (f" ({low:.0f} – {high:.0f})" if low != high else ""))
    return Line((row["method"], row["machines"] or "not recorded", *spans, str(row["runs"])))


def control(rows: list[Row]) -> list[ShownTable]:
    """What policies do beside their data, one table a setting."""
    columns = (
        *("method", "data's return", "return", "return, clean", "above 80%", "above 80%, clean"),
        *("error on path", "in loop", "in loop, clean", "seeds"),
    )
    return [_counted(name, columns, _control_line, members) for name, members in by_setting(rows)]


def _control_line(row: Row) -> Line:
    returns = (number(row[name], 0) for name in ("data_return", "return", "clean_return"))
    shares = (number(row[name], 2) for name in ("share_above_80", "clean_share_above_80"))
    errors = (number(row[name], 4) for name in ("path_error", "action_error", "clean_action_error"))
    return Line((label(row), *returns, *shares, *errors, str(row["seeds"])))


def published(rows: list[dict[str, str]]) -> list[ShownTable]:
    """Scores that others have published."""
    return [ShownTable("", tuple(rows[0]), [Line(tuple(row.values())) for row in rows], words=2)] if rows else []


def _counted(
    title: str, columns: tuple[str, ...], line: Callable[[Row], Line], rows: list[Row], more: str = ""
) -> ShownTable:
    """A table of rows with `seeds`, whose least and greatest number its note tells, and `more`."""
    return ShownTable(title, columns, list(map(line, rows)), note=seeds_note(rows) + more)


def by_setting(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    """Rows by task, quality and corruption, in words."""
    return list(groups(rows, setting).items())
