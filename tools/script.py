"""What the measuring scripts share: a command line from a config class, and a user's slip told in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro

from vd4rl_pomdp.core.errors import UserError

Config = TypeVar("Config")


def run_script(main: Callable[[Config], None], config: type[Config]) -> None:
    """Do `main` by the command line; a UserError ends it in one line and exit code 2."""
    try:
        main(tyro.cli(config))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
