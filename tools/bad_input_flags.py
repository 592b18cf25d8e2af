"""Bad command lines, made from the commands' own config classes: every flag of every command in every bad way."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints
from unittest import mock

import tyro

from vd4rl_pomdp.cli import COMMANDS, main
from vd4rl_pomdp.core.options import StageConfig, flat, options_in

Words = list[str]


@dataclass(frozen=True)
class Case:
    """One bad input: a command line, in a folder of valid files of which some may be spoilt first."""

    command: str
    subject: str
    """The flag or the file that is bad."""
    kind: str
    words: Words
    spoil: Callable[[], None] | None = None
    """What makes the files bad, in the folder where the command runs."""
    may_pass: bool = False
    """Whether nobody may read what is bad: then exit code 0 is right, too."""
    warns: bool = False
    """Whether the command goes on without what is bad: exit code 0 and one line of warning are right, nothing else."""


NAMES = [name for name, entry in COMMANDS.items() if not isinstance(entry, Mapping)] + [
    f"{group} {name}"
    for group, entry in COMMANDS.items()
    for name in (entry if isinstance(entry, Mapping) else entry.inner)
]
"""Every command."""
SET, MAZE, ENCODER = "data/walker_walk/random", "data/no_curtain", "runs/pretrained/encoder"
RUN, NAVIGATED = "runs/finetuned", "runs/navigated"
SMOKE = ["--preset", "smoke"]
STUDY = ["--methods", "none", "--seeds", "0", "--action-noises", "0", "--episodes", "2", "--decisions", "32"]
STUDY += ["--updates", "1", "--eval-episodes", "1"]
VALID: dict[str, Words] = {
    "demo": [],
    "list": [],
    "data collect": ["--task", "walker_walk", "--quality", "random", "--episodes", "1", "--out", "new"],
    "data download": [
        *("--task", "walker_walk", "--quality", "expert", "--out", "new", "--endpoint", "http://127.0.0.1:9"),
    ],
    "data card": [SET],
    "data table": ["--out", "new", "--tasks", "walker_walk", "--qualities", "random"],
    "data check": [SET],
    "data parity": [SET],
    "hub push": [ENCODER, "lab/encoder"],
    "hub pull": ["lab/encoder", "new"],
    "policy train": ["--task", "walker_walk", "--out", "new", "--decisions", "10"],
    "policy export": ["runs/policy", "--out", "new"],
    "pretrain": ["--data", SET, "--out", "new", *SMOKE, "--corruption", "patch+zero_frames"],
    "finetune": ["--encoder", ENCODER, "--data", SET, "--out", "new", *SMOKE, "--workers", "1"],
    "evaluate": [RUN, "--episodes", "1", "--workers", "1"],
    "navigation collect": ["--maze", "no_curtain", "--out", "new", *SMOKE],
    "navigation train": ["--data", MAZE, "--out", "new", *SMOKE],
    "navigation policy": ["--out", "new"],
    "navigation report": [NAVIGATED, "--out", "new", "--no-pictures"],
    "sweep run": ["quick", "--out", "new", "--testing", "--dry-run"],
    "sweep status": ["swept"],
    "sweep retry": ["swept"],
    "sweep list": [],
    "report": ["runs", "--out", "new"],
    "report compare": ["runs", "reports/results", "--out", "new"],
    "results add": ["runs", "--out", "new"],
    "theory": [],
    "control-study": ["--out", "new", *STUDY],
    "bench": ["--quick"],
}
"""Words after each command's name that are right, with files of the folder in which cases run."""

TEXTS = {"nonsense": "@@", "other letters": "ζ", "not UTF-8": os.fsdecode(b"a\xff"), "a newline": "a\nb"}
WHOLE = {"empty": "", "nonsense": "many", "a fraction": "1.5", "nan": "nan", "below": "-7", "huge": str(10**30)}
NUMBERS = {"empty": "", "nonsense": "much", "nan": "nan", "inf": "inf", "below": "-7", "huge": "1e300"}
INPUTS = {
    "empty": "",
    "missing": "nowhere",
    "below a file": "file/below",
    "a foreign file": "file",
    "an empty folder": "empty",
    "a foreign folder": "foreign",
    "a pipe": "pipe",
    "a dangling link": "dangling",
    "a link to itself": "loop",
    "a device": "/dev/zero",
    "a name too long": "n" * 300,
    "not UTF-8": os.fsdecode(b"a\xff"),
}
OUTPUTS = {k: v for k, v in INPUTS.items() if k not in ("missing", "an empty folder")}
HUGE = 10**9
LARGE = {
    "pretrain": ("batch_size", "window", "feature_dim", "hidden_dim", "gru_layers", "head_dim", "max_k", "codes"),
    "finetune": ("batch_size", "hidden_dim", "n_step", "views", "eval_length"),
    "navigation train": ("batch_size", "window", "feature_dim", "hidden_dim", "gru_layers", "head_dim", "codes"),
    "navigation collect": ("trajectory_rows", "trajectories", "action_repeat"),
    "data collect": ("episodes",),
    "policy train": ("replay_size", "hidden", "envs"),
}
"""Flags for which 10^9 is within the range but beyond any machine."""


OTHER_PARTS = {
    "pretrain": (["--method", "homer"], ["--method", "driml"], ["--method", "one_step_inverse"], ["--method", "state"]),
    "finetune": (["--algorithm", "iql"],),
    "navigation train": (["--exogenous", "photographs"], ["--method", "random"]),
}
"""Words that choose other parts, whose options are tried, too."""


class _CaughtError(Exception):
    """Carries a command's config class and defaults out of its parsing."""


def config_of(command: str, *chosen: str) -> tuple[type, Any]:
    """The config class that a command parses its words into, and its defaults if they are not the class's own."""

    def stop(kind: type, **options: Any) -> None:
        raise _CaughtError(kind, options.get("default"))

    with mock.patch("vd4rl_pomdp.cli.parsing.tyro.cli", stop):
        try:
            main([*command.split(), *VALID[command], *chosen, "--help"])
        except _CaughtError as caught:
            return caught.args
    raise AssertionError(f"{command} parses nothing")


def hints_of(config: type, default: Any) -> dict[str, Any]:
    """Type hints of a command's settings by name, those of the chosen parts' options among them."""
    found: dict[str, Any] = {}
    hints = get_type_hints(config, include_extras=True)
    for field in fields(config):
        nested = options_in(getattr(default, field.name, None))
        if nested is None:
            found[field.name] = hints[field.name]
        for options in nested or ():
            found |= hints_of(type(options), options)
    return found


def is_required(config: type, default: Any, name: str) -> bool:
    """Whether a command cannot do without a setting."""
    field = next((field for field in fields(config) if field.name == name), None)
    if field is None:
        return False
    if default is not None:
        return getattr(default, name) is tyro.MISSING
    return field.default is MISSING and field.default_factory is MISSING


def flag_cases() -> Iterator[Case]:
    """Every flag of every command in every bad way, and what is wrong with whole command lines."""
    yield from _unknown_commands()
    for command in NAMES:
        config, default = config_of(command)
        hints = hints_of(config, default)
        yield from _whole_lines(command, hints, [name for name in hints if is_required(config, default, name)])
        for name, hint in hints.items():
            yield from _of_field(command, name, hint)
        for chosen in OTHER_PARTS.get(command, ()):
            for name, hint in hints_of(*config_of(command, *chosen)).items():
                if name not in hints:
                    cases = _of_field(command, name, hint)
                    yield from (replace(case, words=[*case.words, *chosen]) for case in cases)
        for name in LARGE.get(command, ()):
            yield _changed(command, name, "beyond the machine", [str(HUGE)])
    yield from _unread()


def _unknown_commands() -> Iterator[Case]:
    for kind, word in TEXTS.items():
        yield Case("(none)", "the command", kind, [word])
        for group in (name for name, entry in COMMANDS.items() if isinstance(entry, Mapping)):
            yield Case(group, "the command", kind, [group, word])


def _whole_lines(command: str, hints: Mapping[str, Any], required: list[str]) -> Iterator[Case]:
    words = command.split()
    if required:
        yield Case(command, "(all flags)", "bare", words)
    for name in required:
        yield Case(command, name, "left out", [*words, *_without(VALID[command], name, command)])
    yield Case(command, "(all flags)", "an unknown flag", [*words, *VALID[command], "--no-such-flag", "1"])
    yield Case(command, "(all flags)", "a lone dash", [*words, *VALID[command], "-"])
    if not any(_is_positional(h) and _core(h)[1] for h in hints.values()):
        yield Case(command, "(all flags)", "one word more", [*words, *VALID[command], "word", "word"])


def _unread() -> Iterator[Case]:
    """Every method and algorithm with every option that it does not read."""
    from finetune.algorithms import ALGORITHMS
    from finetune.config import FinetuneConfig
    from pretrain.config import PretrainConfig
    from pretrain.objectives import METHODS
    from vd4rl_pomdp.studies.navigation.config import NavigationConfig

    yield from _unread_by("pretrain", PretrainConfig, "method", METHODS)
    yield from _unread_by("navigation train", NavigationConfig, "method", ["ah", "fj+a", "no_history", "random"])
    yield from _unread_by("finetune", FinetuneConfig, "algorithm", ALGORITHMS)
    for line in ("pretrain.literal_future=true", "pretrain.foo=1", "finetune.expectile=0.5", "seed=-1", "preset=huge"):
        words = ["sweep", "run", *VALID["sweep run"], "--change", line]
        yield Case("sweep run", "change", line, words)


def _unread_by(command: str, config: type[StageConfig], chooser: str, names: Iterable[str]) -> Iterator[Case]:
    """Every part of a kind with every option that another one of the kind reads, and it does not."""
    read = {name: flat(config.of("smoke", **{chooser: name})) for name in names}
    every = {option: value for settings in read.values() for option, value in settings.items()}
    for name, settings in read.items():
        for option in sorted(every.keys() - settings.keys()):
            value = every[option]
            flag = [_flag(option)] if isinstance(value, bool) else [_flag(option), str(value or 1)]
            words = [*command.split(), *VALID[command], _flag(chooser), name, *flag]
            yield Case(command, option, f"unread by {name}", words)


def _of_field(command: str, name: str, hint: Any) -> Iterator[Case]:
    kind, many = _core(hint)
    if many and not _is_positional(hint):
        yield _changed(command, name, "no value", [])
    elif kind is bool:
        yield _changed(command, name, "a value", ["maybe"])
    elif not _is_positional(hint):
        yield Case(command, name, "no value", [*command.split(), *_without(VALID[command], name, command), _flag(name)])
    for label, value in _bad_values(name, kind).items():
        yield _changed(command, name, label, [value], _is_positional(hint))


def _bad_values(name: str, kind: Any) -> dict[str, str]:
    if kind is bool:
        return {}
    if kind is int:
        return WHOLE
    if kind is float:
        return NUMBERS
    if kind is Path:
        return OUTPUTS if name == "out" else INPUTS
    return TEXTS if name in MAY_BE_EMPTY else {"empty": "", **TEXTS}


MAY_BE_EMPTY = ("task", "pretrain", "finetune")
"""Texts whose default is empty."""


def _core(hint: Any) -> tuple[Any, bool]:
    """The type of one value, and whether the flag takes a list of them."""
    if hasattr(hint, "__metadata__"):
        hint = hint.__origin__
    if get_origin(hint) is UnionType or isinstance(hint, UnionType):
        hint = next(part for part in get_args(hint) if part is not NoneType)
    if get_origin(hint) is list:
        return _core(get_args(hint)[0])[0], True
    return (str if get_origin(hint) is Literal else hint), False


def _is_positional(hint: Any) -> bool:
    return any(tyro.conf.Positional is marker or "Positional" in repr(marker) for marker in _metadata(hint))


def _metadata(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _without(words: Words, name: str, command: str) -> Words:
    """Valid words without a flag and its values, or without the positional word in front."""
    if _flag(name) not in words:
        hints = hints_of(*config_of(command))
        return words[1:] if name in hints and _is_positional(hints[name]) else words
    start = words.index(_flag(name))
    stop = next((i for i in range(start + 1, len(words)) if words[i].startswith("--")), len(words))
    return words[:start] + words[stop:]


def _changed(command: str, name: str, kind: str, values: Words, positional: bool = False) -> Case:
    """The valid line with other values of one flag."""
    rest = _without(VALID[command], name, command)
    changed = [*values, *rest] if positional else [*rest, _flag(name), *values]
    return Case(command, name, kind, [*command.split(), *changed])
