"""Write the tables made from committed rows into their pages.

    python tools/page_tables.py

A table follows a line `<!-- table: NAME -->` of its page. A test checks that the pages are up to date.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import ladder_table
import navigation_table
import offline_table
from script import run_script

from vd4rl_pomdp.core.errors import UserError

ROOT = Path(__file__).parents[1]
MARK = "<!-- table: {} -->"
"""The line above a table."""
Tables = dict[str, Iterable[str]]
"""Lines of tables by name."""


@dataclass(frozen=True)
class Config:
    """Write the tables made from committed rows into their pages. No options."""


def pages() -> dict[str, Tables]:
    """Tables of each page, by the page's path in the repository."""
    methods = offline_table.runs_of(["methods"], ["methods", "offline", "control"])
    returns, mazes, rungs = offline_table.main_runs(), navigation_table.numbers_in(), ladder_table.cells_in()
    return {
        "results/control/README.md": {
            "gates": offline_table.gate_lines(returns),
            "ranks": offline_table.rank_lines(returns),
        },
        "results/ladder/README.md": {
            "runs": ladder_table.run_lines(rungs),
            "rungs": ladder_table.rung_lines(rungs),
            "budget": ladder_table.budget_lines(rungs),
        },
        "results/methods/README.md": {"methods": offline_table.method_lines(methods)},
        "results/navigation/README.md": {
            "mazes": navigation_table.state_lines(mazes, (15, 1)),
            "three_curtains": navigation_table.maze_lines(mazes, "three_curtains"),
            "textures": navigation_table.texture_lines(mazes),
            "budget": navigation_table.budget_lines(mazes, navigation_table.numbers_in(navigation_table.LONGER)),
        },
        "results/navigation/longer/README.md": {"hard": navigation_table.hard_lines(mazes)},
        "results/navigation/first_person/README.md": {
            "first person": navigation_table.first_person_lines(navigation_table.numbers_in("first_person"))
        },
        "results/navigation/first_person/pictures/README.md": {
            "pictures": navigation_table.picture_lines(mazes),
        },
        "results/navigation/first_person/small/README.md": {
            "first rung": navigation_table.first_rung_lines(navigation_table.numbers_in("first_person/small")),
        },
        "results/offline/README.md": {
            "returns": offline_table.return_lines(returns),
            "contrasts": offline_table.contrast_lines(returns),
            "aggregate": offline_table.aggregate_lines(returns),
        },
    }


def with_tables(text: str, tables: Tables, page: str) -> str:
    """A page's text with its tables filled in.

    Raises:
        UserError: a table's mark is missing, or occurs several times.
    """
    lines = text.split("\n")
    for name, table in tables.items():
        mark = MARK.format(name)
        if lines.count(mark) != 1:
            raise UserError(
                f"{page}: one line `{mark}` is wanted, above where that table belongs; {lines.count(mark)} found"
            )
        start = end = lines.index(mark) + 1
        while end < len(lines) and lines[end].startswith("|"):
            end += 1
        lines[start:end] = table
    return "\n".join(lines)


def main(config: Config) -> None:
    """Write all pages, or none if a mark is missing."""
    written = {
        page: with_tables((ROOT / page).read_text(encoding="utf-8"), tables, page) for page, tables in pages().items()
    }
    for page, text in written.items():
        (ROOT / page).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    run_script(main, Config)
