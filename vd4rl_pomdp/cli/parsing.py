"""From words to settings and calls, with one-line errors; from results to text."""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import tyro

from vd4rl_pomdp.core.errors import UserError, flag_of
from vd4rl_pomdp.core.options import StageConfig
from vd4rl_pomdp.runs.files import flatten

Stage = TypeVar("Stage", bound=StageConfig)
_TYRO = tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName


def parse(config: Any, words: list[str], program: str, default: Any = None) -> Any:
    """Parse the words after the command `program` into a config class, or call a function with them.

    `default` is an instance that holds the defaults.
    """
    for before, word in zip(["", *words], words, strict=False):
        # An empty word would parse as Path("."): `--out "$UNSET"` would write to the working directory.
        if not word or (word.startswith("--") and word.endswith("=")):
            name = word.rstrip("=") or (before if before.startswith("--") else "a word")
            raise UserError(f"{name} is empty: is a shell variable unset? (see `{program} --help`)")
    words = [re.sub("(?<==)~.*", lambda path: os.path.expanduser(path[0]), word, count=1) for word in words]
    options = {} if default is None else {"default": default}
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            parsed = tyro.cli(config, args=words, prog=program, config=_TYRO, **options)
    except SystemExit as end:
        if end.code != 2:
            raise
        lines = (line for line in stderr.getvalue().splitlines() if not line.startswith(("╭", "╰")))
        text = re.sub(r"[\u2500-\u257f]+|-{5,}", " ", " ".join(lines).partition("For full helptext")[0])
        raise UserError(f"{' '.join(text.split())} (see `{program} --help`)") from None
    parsed_values = parsed.keywords if isinstance(parsed, functools.partial) else vars(parsed)
    for word, after in pairwise([*words, "--"]):
        # tyro accepts an empty list, and `sweep run GRID --only $UNSET` would run everything
        if after.startswith("--") and parsed_values.get(word.removeprefix("--").replace("-", "_")) in ([], ()):
            raise UserError(f"{word} has no value: is a shell variable unset? (see `{program} --help`)")
    for name in (name for name, value in parsed_values.items() if isinstance(value, list | tuple)):
        refuse_repeated(flag_of(name), words)
    return parsed


def refuse_repeated(flag: str, words: Iterable[str]) -> None:
    """Raise UserError if a flag of several values is on a command line twice: only the last ones would count."""
    if sum(word.partition("=")[0].replace("_", "-") == flag for word in words) > 1:
        raise UserError(f"{flag} is given twice: give all its values after one {flag}")


def parse_stage(config: type[Stage], words: list[str], program: str) -> Stage:
    """Parse a stage's config. Preset, method and the like are read first: they decide the flags and their defaults."""
    chosen = chosen_by(words, (*config.choosers, *["preset"] * (len(config.presets) > 1)))
    required = {f.name: tyro.MISSING for f in fields(config) if f.default == Path()}
    parsed: Stage = parse(config, words, program, config.of(**chosen, **required))
    parsed.check()
    return parsed


def chosen_by(words: list[str], names: Iterable[str]) -> dict[str, str]:
    """Values of some flags on a command line."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for name in names:
        parser.add_argument(flag_of(name), f"--{name}", dest=name, nargs="?", const="")
    return vars(parser.parse_known_args(words)[0])


def command(function: Callable[..., None]) -> Callable[[list[str], str], None]:
    """Make a command of a function: its parameters are the flags, its docstring is the help."""

    @functools.wraps(function)
    def bound(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return lambda words, program: parse(bound, words, program)()


def show(result: dict[str, Any], as_json: bool) -> None:
    """Print a result as one JSON object, or as an aligned list, in which a long list is its ends and its length."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in flatten(result).items():
        if isinstance(value, list):
            value = " ".join(map(str, value if len(value) <= 6 else [value[0], "...", value[-1], f"({len(value)})"]))
        print(f"{name:<40} {f'{value:.6g}' if isinstance(value, float) else value}")
