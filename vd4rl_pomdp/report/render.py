"""Renders tables of text as HTML, LaTeX and on the terminal, and fills the HTML templates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.report.stats import FEW_SEEDS, number, with_interval
from vd4rl_pomdp.runs.files import Row, write_bytes

SENTENCE = 48  # characters above which a LaTeX column wraps
SYMBOLS = {"→": r"$\rightarrow$", "†": r"\dag{}", "–": "--", "×": r"$\times$"}
Columns = dict[str, str | tuple[str, int] | tuple[str, str, str, int] | Callable[[Row], str]]
"""Columns of a displayed table by title. Each shows a row's text, a number with a given number of digits, a number with
its interval, or the result of a function."""
_LOADER = jinja2.PackageLoader("vd4rl_pomdp.report", "")
_TEMPLATES = jinja2.Environment(loader=_LOADER, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)


def render(template: str, **values: Any) -> str:
    """Fill one of this package's templates."""
    return _TEMPLATES.get_template(template).render(**values)


def texts(rows: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """A table's displayed texts, with the index of its rows."""

    def text(row: Row, what: Any) -> str:
        if callable(what):
            return one_line(what(row))
        if isinstance(what, str):
            return one_line(str(row[what]))
        *names, digits = what
        in_words: Callable[..., str] = number if len(names) == 1 else with_interval
        return in_words(*(row[name] for name in names), digits)

    shown = [{title: text(row, what) for title, what in columns.items()} for row in rows.to_dict("records")]
    return pd.DataFrame(shown, rows.index, columns=list(columns))


class Block(NamedTuple):
    """A table as displayed on the page."""

    title: str
    html: str
    rows: int
    note: str  # its sample size n


def block(title: str, table: pd.DataFrame, words: int, note: str = "") -> Block:
    """A table for the page. The first `words` columns are left-aligned text, the others numbers."""
    with pd.option_context("display.max_colwidth", None):
        return Block(title, table.to_html(index=False, border=0, classes=f"words{words}"), len(table), note)


def write_latex(path: Path, table: pd.DataFrame, words: int, note: str = "") -> None:
    """Write a table of text as LaTeX (needs booktabs and longtable). Unencodable characters become escapes."""
    wide = [max(map(len, table[name]), default=0) > SENTENCE for name in table.columns[:words]]
    form = "".join(r"p{0.3\linewidth}" if sentences else "l" for sentences in wide)
    form += "r" * (len(table.columns) - words)
    marked = table.astype(str).apply(lambda column: column.str.contains("†")).to_numpy().any()
    caption = f"{note}{f' †: fewer than {FEW_SEEDS} seeds.' if marked else ''}".strip().replace("%", r"\%")
    text = table.to_latex(index=False, escape=True, column_format=form, caption=caption, longtable=True)
    for symbol, command in SYMBOLS.items():
        text = text.replace(symbol, command)
    write_bytes(path, f"% \\usepackage{{booktabs, longtable}}\n{text}".encode(errors="backslashreplace"))


def print_setting(console: Console, setting: str, memory: str, table: pd.DataFrame) -> None:
    """Print a setting's verdict on memory and its table of text, whose first column and gaps wrap; numbers do not."""
    console.print(one_line(f"{setting}, memory: {memory}"), markup=False, highlight=False)
    shown = Table(title=Text(setting), title_justify="left")
    for name in table.columns:
        words = name in (table.columns[0], "no result")
        shown.add_column(name, overflow="fold", justify="left" if words else "right", no_wrap=not words)
    for row in table.itertuples(index=False):
        shown.add_row(*map(Text, row))
    console.print(shown)
