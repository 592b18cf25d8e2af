"""Words to configs, with one-line errors for bad ones, and results to text."""

from __future__ import annotations

import contextlib
import io
import json
import re
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments
from vd4rl_pomdp.errors import UserError, flag_of
from vd4rl_pomdp.runs.files import flatten

_LONGEST_LIST = 6


def parse(config: Any, words: Arguments, program: str, default: Any = None) -> Any:
    """Arguments as an instance of a config class; `--preset`-like defaults come in as `default`."""
    options = {} if default is None else {"default": default}
    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            parsed = tyro.cli(config, args=words, prog=program, description=config.__doc__, **options)
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise UserError(_one_line(shown.getvalue(), program)) from None
    _refuse_empty(parsed, words)
    return parsed


def _refuse_empty(config: Any, words: Arguments) -> None:
    """Refuse a flag that names nothing: an empty list, or an empty word where the default is none."""
    for field in fields(config):
        if getattr(config, field.name) == []:
            raise UserError(f"{flag_of(field.name)} names nothing: give at least one or leave it out")
    free = {flag_of(field.name) for field in fields(config) if field.default == ""}
    for flag, word in pairwise(["", *words]):
        if (word == "" and flag not in free) or (word.startswith("--") and word[-1] == "=" and word[:-1] not in free):
            raise UserError(f"{word or flag or 'the first word'} names nothing: give a value or leave it out")


def _one_line(box: str, program: str) -> str:
    """tyro's boxed message, without its title and frame, as one sentence."""
    text = " ".join(line for line in box.splitlines() if not line.startswith(("╭", "╰")))
    text = re.sub(r"[\u2500-\u257f]+|-{5,}", " ", text.partition("For full helptext")[0])
    return f"{' '.join(text.split())} (see `{program} --help`)"


def with_presets(config: type, presets: dict[str, Any], words: Arguments, program: str, flag: str = "--preset") -> Any:
    """Parse a stage's config one of whose flags, `--preset`, chooses the defaults of all others."""
    name = next(iter(presets))
    for word, following in pairwise([*words, ""]):
        if word == flag:
            name = following
        elif word.startswith(f"{flag}="):
            name = word.partition("=")[2]
    if name not in presets:
        raise UserError(f"unknown {flag.removeprefix('--')} {name!r}: choose one of {', '.join(presets)}")
    default = presets[name]
    required = [f for f in ("encoder", "data", "out", "maze") if getattr(default, f, None) in (Path(), "")]
    missing = {f: tyro.MISSING for f in required}
    return parse(config, words, program, replace(default, **missing))


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
