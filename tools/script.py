"""Shared by the measuring scripts: a command line from a config class, with one-line errors, and Markdown tables."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import tyro

from vd4rl_pomdp.core.errors import UserError

Config = TypeVar("Config")


@contextmanager
def one_line_errors() -> Iterator[None]:
    """A UserError exits with one line and code 2."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def run_script(main: Callable[[Config], None], config: type[Config]) -> None:
    """Run `main` with the command line's config."""
    with one_line_errors():
        main(tyro.cli(config))


def table(head: Sequence[str], rows: Iterable[Iterable[object]], left: Collection[int] = (0,)) -> Iterator[str]:
    """Lines of a Markdown table; `left` are the columns of text, the others are aligned right."""
    yield f"| {' | '.join(head)} |".replace("|  |", "| |")
    yield "|" + "".join("---|" if i in left else "---:|" for i in range(len(head)))
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)
