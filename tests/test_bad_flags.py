"""Invalid flag values end every command with one line and exit code 2, and write nothing."""

import contextlib
import os
from collections.abc import Callable
from functools import cache
from inspect import signature
from pathlib import Path
from typing import get_args, get_type_hints
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import helpers_bad_input
from tests.helpers_bad_input import WITHOUT_OUT, build_world, end_of, snapshot
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import flag_of
from vd4rl_pomdp.core.options import options_in

UNTRIED = ("demo", "data download", "navigation train", "navigation policy", "navigation report", "certify")
"""Commands that need other files, or too long if they miss an invalid value."""
VALID = {
    command: words if command in WITHOUT_OUT else [*words, "--out", "new"]
    for command, words in helpers_bad_input.VALID.items()
    if command not in UNTRIED
}
"""Valid arguments of each command; each test replaces one value with an invalid one."""
NO_FILE = ["nowhere", "file/below", "file", "empty", "foreign", "loop", "/dev/null", "n" * 300, os.fsdecode(b"a\xff")]
WRONG = {
    bool: ["maybe"],
    int: ["", "many", "1.5", "nan", "-7", str(10**30)],
    float: ["", "much", "nan", "inf", "-7"],
    str: ["@@", "ζ", os.fsdecode(b"a\xff"), "a\nb"],
    Path: ["", *NO_FILE],
}
RIGHT = {
    *((command, "out", "empty") for command in VALID),
    *((command, "out", "nowhere") for command in VALID),
    *(("sweep run", flag, word) for flag in ("out", "data") for word in ("nowhere", "empty", "foreign")),
}
"""Valid values: an output folder may be new or empty."""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    build_world(folder)
    with contextlib.chdir(folder):
        yield folder


class _FoundError(Exception):
    """Carries a command's config class and defaults out of its parsing."""


@cache
def flags_of(command: str) -> dict[str, type]:
    """Type of one value of every flag of a command."""

    def stop(kind, **given):
        raise _FoundError(kind, given.get("default"))

    with mock.patch("tyro.cli", stop), pytest.raises(_FoundError) as found:
        main([*command.split(), *VALID[command]])
    return _flags(*found.value.args)


def _flags(config: Callable[..., object], default: object) -> dict[str, type]:
    found, hints = {}, get_type_hints(config)
    for name, parameter in signature(config).parameters.items():
        nested = options_in(getattr(default, name, None))
        if nested is not None:
            for options in nested:
                found |= _flags(type(options), options)
        elif "Positional" not in str(parameter.annotation):
            kinds = [part for part in (hints[name], *get_args(hints[name])) if part in WRONG]
            found[name] = kinds[0] if kinds else str
    return found


@cache
def wrong() -> list[tuple[str, str, str]]:
    """All (command, flag, invalid value)."""
    found = [(command, flag, v) for command in VALID for flag, kind in flags_of(command).items() for v in WRONG[kind]]
    assert {command for command, *_ in found} == set(VALID)
    return [case for case in found if case not in RIGHT]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(data=st.data())
def test_invalid_flag_values_print_one_line_and_write_nothing(world, data):
    command, flag, value = data.draw(st.sampled_from(wrong()))
    words = [*command.split(), *VALID[command]]
    if flag_of(flag) in words:
        start = words.index(flag_of(flag))
        del words[start : start + 2]
    before = snapshot(world)
    code, stderr = end_of([*words, flag_of(flag), value])
    assert (code, stderr.count("\n"), stderr[:7]) == (2, 1, "error: "), stderr
    assert snapshot(world) == before
