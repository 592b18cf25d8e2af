"""A report in short, on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from vd4rl_pomdp.report.claims import tally
from vd4rl_pomdp.report.gaps import MISSING
from vd4rl_pomdp.report.layout import interval, number
from vd4rl_pomdp.report.present import by_setting
from vd4rl_pomdp.report.tables import SCORE, grouped, label, with_algorithm
from vd4rl_pomdp.report.write import Report
from vd4rl_pomdp.runs.files import Row


def print_summary(report: Report, console: Console | None = None) -> None:
    """The verdicts of the gates and claims, then the tables of final scores, one a setting."""
    console = console or Console()
    for row in report.gates:
        console.print(f"{with_algorithm(row)}: {row['verdict']}", markup=False, highlight=False)
    for (claim,), members in grouped(report.claims, ("claim",)):
        if told := tally(members):
            console.print(f"{claim}: {told}", markup=False, highlight=False)
    console.print(f"{SCORE}; mean over seeds [95% t interval]", markup=False, highlight=False)
    for place, members in by_setting(report.summary):
        console.print(_table(place, members))


def _table(title: str, rows: list[Row]) -> Table:
    table = Table(title=Text(title), title_justify="left")
    table.add_column("method", overflow="fold")
    for name in ("score", "interval", "seeds", "episodes"):
        table.add_column(name, justify="right", no_wrap=True)
    gaps = any(row["missing"] for row in rows)
    if gaps:
        table.add_column("not there", overflow="fold")
    for row in rows:
        score = MISSING if row["score"] is None else number(row["score"])
        texts = (label(row), score, interval(row["low"], row["high"]), str(row["seeds"]), str(row["episodes"]))
        gap = row["missing"].removesuffix(f" {MISSING}")  # its column's title says so, and labels need the room
        table.add_row(*map(Text, (*texts, gap) if gaps else texts))
    return table
