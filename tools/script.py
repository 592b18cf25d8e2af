"""Shared by the measuring scripts: a command line from a config class, with one-line errors."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
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
