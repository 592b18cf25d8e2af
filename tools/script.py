"""Entry point of the measuring scripts: a command line from a config class, with one-line errors."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro

from vd4rl_pomdp.core.errors import UserError

Config = TypeVar("Config")


def run_script(main: Callable[[Config], None], config: type[Config]) -> None:
    """Run `main` with the command line's config; a UserError exits with one line and code 2."""
    try:
        main(tyro.cli(config))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
