"""Words to configs, with one-line errors for bad ones, and results to text."""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import tyro

from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_unknown
from vd4rl_pomdp.core.options import StageConfig
from vd4rl_pomdp.runs.files import flatten

Command = Callable[[list[str], str], None]
Stage = TypeVar("Stage", bound=StageConfig)
_LONGEST_LIST = 6


def parse(config: Any, words: list[str], program: str, default: Any = None) -> Any:
    """Words as an instance of a config class, or as what a function returns for them.

    Args:
        config: the class or function.
        words: of a command line, behind the command.
        program: what stands before them.
        default: an instance that has the defaults.
    """
    for before, word in zip(["", *words], words, strict=False):
        # As a Path an empty word would be the working directory: `--out "$UNSET"` would write there.
        if not word or (word.startswith("--") and word.endswith("=")):
            name = word.rstrip("=") or (before if before.startswith("--") else "a word")
            raise UserError(f"{name} is empty: is a variable of the shell not set? (see `{program} --help`)")
    words = [re.sub("(?<==)~.*", lambda path: os.path.expanduser(path[0]), word, count=1) for word in words]
    options = {} if default is None else {"default": default}
    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            return tyro.cli(config, args=words, prog=program, config=(tyro.conf.OmitArgPrefixes,), **options)
    except SystemExit as end:
        if end.code != 2:
            raise
        lines = (line for line in shown.getvalue().splitlines() if not line.startswith(("╭", "╰")))
        text = re.sub(r"[\u2500-\u257f]+|-{5,}", " ", " ".join(lines).partition("For full helptext")[0])
        raise UserError(f"{' '.join(text.split())} (see `{program} --help`)") from None


def command(function: Callable[..., None]) -> Command:
    """A command whose flags are a function's parameters, described in its docstring."""

    @functools.wraps(function)
    def bound(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return lambda words, program: parse(bound, words, program)()


def parse_stage(config: type[Stage], words: list[str], program: str) -> Stage:
    """Parse a stage's config: preset, method and the like decide which flags there are, and their defaults."""
    chosen = _chosen(words, (*config.choosers, *["preset"] * (len(config.presets) > 1)))
    required = {f.name: tyro.MISSING for f in fields(config) if f.default == Path()}
    parsed: Stage = parse(config, words, program, config.of(**chosen, **required))
    parsed.check()
    return parsed


def with_presets(config: type, presets: dict[str, Any], words: list[str], program: str) -> Any:
    """Parse a config whose flag `--preset` chooses the defaults of all others."""
    name = _chosen(words, ["preset"]).get("preset", next(iter(presets)))
    refuse_unknown("preset", name, presets)
    default = presets[name]
    missing = {f.name: tyro.MISSING for f in fields(config) if getattr(default, f.name) in (Path(), "")}
    return parse(config, words, program, replace(default, **missing))


def _chosen(words: list[str], names: Iterable[str]) -> dict[str, str]:
    """The values that a command line gives some flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for name in names:
        parser.add_argument(flag_of(name), f"--{name}", dest=name, nargs="?", const="")
    return vars(parser.parse_known_args(words)[0])


def show(result: dict[str, Any], as_json: bool) -> None:
    """Print a result as one JSON object, or as an aligned list."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in flatten(result).items():
        print(f"{name:<40} {_text(value)}")


def _text(value: Any) -> str:
    """A value on one line; of a long list its ends and its length."""
    if isinstance(value, list):
        shown = value if len(value) <= _LONGEST_LIST else [value[0], "...", value[-1], f"({len(value)})"]
        return " ".join(map(str, shown))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
