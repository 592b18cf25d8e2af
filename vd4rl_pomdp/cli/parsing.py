"""From functions to commands, from results to text."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from typing import Any

from vd4rl_pomdp.core.parsing import parse
from vd4rl_pomdp.runs.files import flatten

Command = Callable[[list[str], str], None]
_LONGEST_LIST = 6


def command(function: Callable[..., None]) -> Command:
    """Make a command of a function: its parameters are the flags, its docstring is the help."""

    @functools.wraps(function)
    def bound(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return lambda words, program: parse(bound, words, program)()


def show(result: dict[str, Any], as_json: bool) -> None:
    """Print a result as one JSON object, or as an aligned list."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in flatten(result).items():
        print(f"{name:<40} {_text(value)}")


def _text(value: Any) -> str:
    """A value as one line; long lists are shortened to their ends and length."""
    if isinstance(value, list):
        items = value if len(value) <= _LONGEST_LIST else [value[0], "...", value[-1], f"({len(value)})"]
        return " ".join(map(str, items))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
