"""Words to configs, with one-line errors for bad ones, and results to text."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from dataclasses import MISSING, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_unknown
from vd4rl_pomdp.core.options import StageConfig, flat, option_names
from vd4rl_pomdp.runs.files import flatten
from vd4rl_pomdp.runs.interrupt import Terminated

_LONGEST_LIST = 6
_FLAT = (tyro.conf.OmitArgPrefixes,)
"""Options are nested in Python, their flags are not."""
Stage = TypeVar("Stage", bound=StageConfig)


def parse(config: Any, words: Arguments, program: str, default: Any = None) -> Any:
    """Arguments as an instance of a config class; `--preset`-like defaults come in as `default`."""
    options = {} if default is None else {"default": default}
    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            parsed = tyro.cli(
                config,
                args=[_at_home(word) for word in words],
                prog=program,
                description=config.__doc__,
                config=_FLAT,
                **options,
            )
    except SystemExit as end:
        if end.code in (0, None) or isinstance(end, Terminated):
            raise
        raise UserError(_one_line(shown.getvalue(), program)) from None
    _refuse_empty(parsed, words)
    _refuse_twice(parsed, words)
    return parsed


def _at_home(word: str) -> str:
    """A word with the user's folder in place of `~` in `--out=~/runs`, which shells leave as it is."""
    flag, _, value = word.partition("=")
    return f"{flag}={os.path.expanduser(value)}" if flag.startswith("--") and value.startswith("~") else word


def _refuse_empty(config: Any, words: Arguments) -> None:
    """Refuse a flag that names nothing: an empty list, or an empty word where the default is none."""
    for field in fields(config):
        if getattr(config, field.name) == [] and (field.default_factory is not list or flag_of(field.name) in words):
            if field.default_factory is MISSING:  # a positional one
                raise UserError(f"no {field.name} are named: name at least one")
            raise UserError(f"{flag_of(field.name)} names nothing: give at least one or leave it out")
    free = {flag_of(field.name) for field in fields(config) if field.default == ""}
    for flag, word in pairwise(["", *words]):
        if (word == "" and flag not in free) or (word.startswith("--") and word[-1] == "=" and word[:-1] not in free):
            raise UserError(f"{word or flag or 'the first word'} names nothing: give a value or leave it out")


def _refuse_twice(config: Any, words: Arguments) -> None:
    """Refuse a second flag of a list: of the two the last would count, and what the first names be lost unnoticed."""
    given = [word.partition("=")[0].replace("_", "-") for word in words]
    for flag in (flag_of(name) for name, value in flat(config).items() if isinstance(value, list)):
        if given.count(flag) > 1:
            raise UserError(f"{flag} is given twice: name all its values behind one {flag}")


def _one_line(box: str, program: str) -> str:
    """tyro's boxed message, without its title and frame, as one sentence."""
    text = " ".join(line for line in box.splitlines() if not line.startswith(("╭", "╰")))
    text = re.sub(r"[\u2500-\u257f]+|-{5,}", " ", text.partition("For full helptext")[0])
    return f"{' '.join(text.split())} (see `{program} --help`)"


def parse_stage(config: type[Stage], words: Arguments, program: str) -> Stage:
    """Parse a stage's config: preset, method and the like decide which flags there are, and their defaults."""
    choosers = (*config.choosers, *["preset"] * (len(config.presets) > 1))
    chosen = {name: value for name in choosers if (value := _chosen(words, name)) is not None}
    required = {f.name: tyro.MISSING for f in fields(config) if f.default == Path()}
    default = config.of(**chosen, **required)
    _refuse_unread(default, words)
    parsed = parse(config, words, program, default)
    parsed.check()
    return parsed


def _refuse_unread(default: StageConfig, words: Arguments) -> None:
    """Refuse a flag that only parts which were not chosen read, and say which chosen one does not."""
    flags = (word.partition("=")[0][2:].replace("-", "_") for word in words if word.startswith("--"))
    names = (flag.removeprefix("no_") for flag in flags)
    optional = option_names()
    default.check_read(name for name in names if name in optional)


def _chosen(words: Arguments, name: str) -> str | None:
    """The value that a command line gives a flag, the last if there are several."""
    value = None
    for word, following in pairwise([*words, ""]):
        flag, equals, text = word.partition("=")
        if flag.replace("_", "-") == flag_of(name):
            value = text if equals else following
    return value


def with_presets(config: type, presets: dict[str, Any], words: Arguments, program: str, flag: str = "--preset") -> Any:
    """Parse a config with a flag, `--preset`, that chooses the defaults of all others."""
    name = _chosen(words, flag.removeprefix("--")) or next(iter(presets))
    refuse_unknown(flag.removeprefix("--"), name, presets)
    default = presets[name]
    missing = {f.name: tyro.MISSING for f in fields(config) if getattr(default, f.name) in (Path(), "")}
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
