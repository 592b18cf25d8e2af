"""Write the tables made from committed rows into their pages.

    python tools/page_tables.py

A table follows a line `<!-- table: NAME -->` of its page. A test checks that the pages are up to date.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import earlier_table as earlier
import ladder_table as ladder
import navigation_table as mazes
import protocol_table as protocol

from vd4rl_pomdp.core.errors import UserError

ROOT = Path(__file__).parents[1]
MARK = "<!-- table: {} -->"
"""The line above a table."""
Tables = dict[str, Iterable[str]]
"""Lines of tables by name."""


def pages() -> dict[str, Tables]:
    """Tables of each page, by the page's path in the repository."""
    frozen = earlier.runs_of([str(ROOT / "results" / "protocol.toml")], ["protocol"], protocol.SECOND_BUDGETS)
    methods, returns = earlier.runs_of(["methods"], ["earlier/methods", *earlier.FOLDERS]), earlier.main_runs()
    numbers, rungs, condition = mazes.numbers_in(), ladder.cells_in(), mazes.Condition("", "")
    by_k = [(f"K = {k}", condition._replace(max_k=k)) for k in (15, 1)]
    tables: dict[str, Tables] = {
        "earlier": {
            "returns": earlier.return_lines(returns),
            "contrasts": earlier.contrast_lines(returns),
            "methods": earlier.method_lines(methods),
        },
        "ladder": {
            "runs": ladder.run_lines(rungs),
            "rungs": ladder.rung_lines(rungs),
            "budget": ladder.budget_lines(rungs),
        },
        "navigation": {
            "mazes": mazes.state_lines(numbers, by_k),
            "three_curtains": mazes.maze_lines(numbers, "three_curtains"),
            "textures": mazes.state_lines(numbers, [("textures", condition._replace(exogenous=True))]),
            "budget": mazes.budget_lines(numbers, mazes.numbers_in("budget")),
        },
        "navigation/longer": {"hard": mazes.place_lines(numbers, mazes.HARD, (*mazes.ORDER, *mazes.REFERENCES))},
        "navigation/first_person": {"first person": mazes.first_person_lines(mazes.numbers_in("first_person"))},
        "navigation/first_person/pictures": {"pictures": mazes.picture_lines(numbers)},
        "navigation/first_person/small": {
            "first rung": mazes.place_lines(
                mazes.numbers_in("first_person/small"), (mazes.STARS, mazes.COMPASS), mazes.SMALLEST
            )
        },
        "protocol": {
            "methods": protocol.method_lines(frozen),
            "contrasts": protocol.contrast_lines(frozen),
            "paired": protocol.paired_lines(frozen),
        },
    }
    return {f"results/{place}/README.md": of_page for place, of_page in tables.items()}


def with_tables(text: str, tables: Tables, page: str) -> str:
    """A page's text with its tables filled in.

    Raises:
        UserError: a table's mark is missing, or occurs several times.
    """
    lines = text.split("\n")
    for name, table in tables.items():
        mark = MARK.format(name)
        if (count := lines.count(mark)) != 1:
            raise UserError(f"{page}: expected one line `{mark}` above that table, found {count}")
        start = end = lines.index(mark) + 1
        while end < len(lines) and lines[end].startswith("|"):
            end += 1
        lines[start:end] = table
    return "\n".join(lines)


def main() -> None:
    """Write all pages, or none if a mark is missing."""
    found = [(ROOT / page, page, tables) for page, tables in pages().items()]
    written = {path: with_tables(path.read_text(encoding="utf-8"), tables, page) for path, page, tables in found}
    for path, text in written.items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
