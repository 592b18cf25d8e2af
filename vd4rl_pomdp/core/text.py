"""Names that others chose, such as a method's, as text that a page, a figure or a terminal shows as it is."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

_ENTITIES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;", "$": "&#36;", "`": "&#96;"}
_MARKS = re.compile(r"([\\*\[\]~]|(?<!\w)_|_(?!\w))")


def one_line(text: str) -> str:
    """Text on one line, with a question mark for every character that cannot be shown."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()).replace("\t", " "))


def markdown(text: str) -> str:
    """Text for a Markdown paragraph or table cell that neither ends it nor marks anything up."""
    marked = _MARKS.sub(r"\\\1", one_line(text))
    return "".join(_ENTITIES.get(c, c) for c in marked)


def code(text: str) -> str:
    """Text as a Markdown code span that fits into a table cell."""
    shown = one_line(text).replace("|", r"\|")
    fence = _fence(shown, 1)
    return f"{fence}{shown}{fence}" if "`" not in shown else f"{fence} {shown} {fence}"


def code_block(lines: list[str], language: str) -> list[str]:
    """Lines as a fenced Markdown block that no line of them ends."""
    shown = list(map(one_line, lines))
    fence = _fence("\n".join(shown), 3)
    return [f"{fence}{language}", *shown, fence]


def _fence(text: str, least: int) -> str:
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    return "`" * max(least, longest + 1)


def plain(text: str, width: int | None = None) -> str:
    """Text for a figure: no formula between dollars, no label hidden by a leading underscore, wrapped to `width`."""
    shown = one_line(text)
    lines = textwrap.wrap(shown, width, break_long_words=True) if width else [shown]
    joined = "\n".join(lines).replace("$", r"\$")
    return f" {joined}" if joined.startswith("_") else joined


def write_text(path: Path, text: str) -> None:
    """Write a page as UTF-8; what UTF-8 cannot hold, such as half a character of a file's name, is spelt out."""
    path.write_text(text, encoding="utf-8", errors="backslashreplace")
