"""Tables of texts as HTML and LaTeX, and this package's HTML templates, which share one frame, base.html."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import pandas as pd

from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.report.stats import FEW_SEEDS
from vd4rl_pomdp.runs.files import Row, write_bytes

SENTENCE = 48
"""Letters from which on a cell does not fit on a page of LaTeX beside others."""
_SYMBOLS = {"→": r"$\rightarrow$", "†": r"\dag{}", "–": "--", "×": r"$\times$"}
Columns = dict[str, Callable[[Row], str]]
"""Titles of a shown table's columns, and the text of each in a row."""

_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("vd4rl_pomdp.report", ""),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """The page that a template of this package makes of some values."""
    return _TEMPLATES.get_template(template).render(**values)


class Block(NamedTuple):
    """A table as the page shows it."""

    title: str
    html: str
    rows: int
    note: str
    """n of what it shows."""


def texts(rows: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """A table as a reader sees it, with the index of its rows."""
    shown = [{name: one_line(text(row)) for name, text in columns.items()} for row in rows.to_dict("records")]
    return pd.DataFrame(shown, rows.index, columns=list(columns))


def block(title: str, table: pd.DataFrame, words: int, note: str = "") -> Block:
    """A table for the page; the first `words` columns hold words, the others numbers."""
    with pd.option_context("display.max_colwidth", None):
        return Block(title, table.to_html(index=False, border=0, classes=f"words{words}"), len(table), note)


def write_latex(path: Path, table: pd.DataFrame, words: int, note: str = "") -> None:
    """Write a table of texts in LaTeX, which needs booktabs and longtable; what UTF-8 cannot hold is spelt out."""
    form = "".join(_words_column(table[name]) for name in table.columns[:words]) + "r" * (len(table.columns) - words)
    caption = f"{note} †: fewer than {FEW_SEEDS} seeds.".strip().replace("%", r"\%")
    text = table.to_latex(index=False, escape=True, column_format=form, caption=caption, longtable=True)
    for symbol, command in _SYMBOLS.items():
        text = text.replace(symbol, command)
    write_bytes(path, f"% \\usepackage{{booktabs, longtable}}\n{text}".encode(errors="backslashreplace"))


def _words_column(cells: Iterable[str]) -> str:
    """Sentences are broken into lines."""
    return r"p{0.3\linewidth}" if any(len(cell) > SENTENCE for cell in cells) else "l"
