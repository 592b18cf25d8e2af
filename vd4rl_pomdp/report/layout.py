"""Tables as a reader sees them, which the page shows and LaTeX sets: texts in rows, under one line of titles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.runs.files import write_bytes

_ESCAPES = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}"},
    **{"–": "--", "†": r"\dag{}", "±": r"$\pm$", "×": r"$\times$", "→": r"$\rightarrow$"},
}
_SENTENCE = 48
"""Letters from which on a cell does not fit on a page beside others."""


class Line(NamedTuple):
    """One row of a table."""

    cells: tuple[str, ...]
    note: str = ""
    """Stands in place of the cells that are missing at its end."""


@dataclass(frozen=True)
class ShownTable:
    """A table with its title."""

    title: str
    columns: tuple[str, ...]
    lines: list[Line]
    words: int = 1
    """Columns at the left that hold words; the others hold numbers."""
    note: str = ""
    """n of what it shows."""


def number(value: float | None, digits: int = 1) -> str:
    """A number, or a dash for one that is not known."""
    return "–" if value is None else f"{value:z.{digits}f}"


def interval(low: float | None, high: float | None, digits: int = 1) -> str:
    """An interval in brackets, or a dash."""
    return "–" if low is None or high is None else f"[{low:z.{digits}f}, {high:z.{digits}f}]"


def with_interval(value: float | None, low: float | None, high: float | None, digits: int = 1) -> str:
    """A number and its interval, as far as they are known."""
    return number(value, digits) if low is None else f"{number(value, digits)} {interval(low, high, digits)}"


def write_latex(path: Path, tables: Sequence[ShownTable], note: str) -> None:
    """Write tables as `latex` sets them; letters that UTF-8 cannot hold are written by their numbers."""
    write_bytes(path, latex(tables, note).encode(errors="backslashreplace"))


def latex(tables: Sequence[ShownTable], note: str) -> str:
    """Tables in LaTeX, one float each with its title and a note as caption; they need the package booktabs."""
    return "% \\usepackage{booktabs}\n" + "\n".join(_float(table, note) for table in tables)


def _float(table: ShownTable, note: str) -> str:
    words = "".join(_words_column([line.cells[i] for line in table.lines]) for i in range(table.words))
    form = words + "r" * (len(table.columns) - table.words)
    caption = " ".join(filter(None, (f"{table.title}." if table.title else "", note, table.note)))
    lines = [_line(line, len(table.columns)) for line in table.lines]
    return "\n".join(
        [
            *(r"\begin{table}", r"\centering", rf"\caption{{{escape(caption)}}}", rf"\begin{{tabular}}{{{form}}}"),
            *(r"\toprule", _cells(table.columns), r"\midrule", *lines, r"\bottomrule"),
            *(r"\end{tabular}", r"\end{table}", ""),
        ]
    )


def _words_column(texts: list[str]) -> str:
    """Sentences are broken into lines."""
    return r"p{0.4\linewidth}" if any(len(text) > _SENTENCE for text in texts) else "l"


def _line(line: Line, columns: int) -> str:
    if not line.note:
        return _cells(line.cells)
    rest = rf"\multicolumn{{{columns - len(line.cells)}}}{{l}}{{\emph{{{escape(line.note)}}}}}"
    return f"{' & '.join([*map(escape, line.cells), rest])} \\\\"


def _cells(texts: Sequence[str]) -> str:
    return f"{' & '.join(map(escape, texts))} \\\\"


def escape(text: str) -> str:
    """Text that LaTeX sets as it is."""
    return "".join(_ESCAPES.get(c, c) for c in one_line(text))
