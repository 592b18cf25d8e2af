"""Escapes user-chosen names, such as a method's, for Markdown pages, figures and terminals."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

_ENTITIES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;", "$": "&#36;", "`": "&#96;"}
_MARKS = re.compile(r"([\\*\[\]~]|(?<!\w)_|_(?!\w))")


def one_line(text: str) -> str:
    """Text on one line, with "?" for unprintable characters."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()).replace("\t", " "))


def counted(number: int, noun: str) -> str:
    """Such as "1 episode" and "2 episodes"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def markdown(text: str) -> str:
    """Escape text for a Markdown paragraph or table cell."""
    marked = _MARKS.sub(r"\\\1", one_line(text))
    return "".join(_ENTITIES.get(c, c) for c in marked)


def code(text: str) -> str:
    """Text as a Markdown code span that is safe in a table cell."""
    line = one_line(text).replace("|", r"\|")
    fence, space = _fence(line, 1), " " * ("`" in line)
    return f"{fence}{space}{line}{space}{fence}"


def code_block(lines: list[str], language: str) -> list[str]:
    """Lines as a fenced Markdown block, with a fence longer than any in the text."""
    cleaned = list(map(one_line, lines))
    fence = _fence("\n".join(cleaned), 3)
    return [f"{fence}{language}", *cleaned, fence]


def table_lines(head: Sequence[str], rows: Iterable[Iterable[object]], left: Collection[int] = (0,)) -> Iterator[str]:
    """Lines of a Markdown table of escaped cells; `left` are the columns of text, the others are aligned right."""
    yield f"| {' | '.join(head)} |".replace("|  |", "| |")
    yield "|" + "".join("---|" if i in left else "---:|" for i in range(len(head)))
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)


def _fence(text: str, least: int) -> str:
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    return "`" * max(least, longest + 1)


def plain(text: str, width: int | None = None) -> str:
    """Escape text for matplotlib (no $math$, no leading underscore, which hides a label); wrap to `width`."""
    cleaned = one_line(text)
    lines = textwrap.wrap(cleaned, width, break_long_words=True) if width else [cleaned]
    joined = "\n".join(lines).replace("$", r"\$")
    return f" {joined}" if joined.startswith("_") else joined


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text; characters that UTF-8 cannot encode (e.g. lone surrogates in file names) become escapes."""
    path.write_text(text, encoding="utf-8", errors="backslashreplace")
