"""From a command line's first words to the function that they name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from vd4rl_pomdp.core.errors import UserError

PROGRAM = "vd4rl-pomdp"
Arguments = list[str]


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    summary: str
    run: Callable[[Arguments, str], None]
    inner: Mapping[str, Command] = field(default_factory=dict)
    """Commands that its first word may name in its place."""


Commands = Mapping[str, Command | Mapping[str, Command]]
"""Subcommands by name, and groups of them."""


COMMANDS: dict[str, Command | Mapping[str, Command]] = {}
"""The program's subcommands, as they are listed. Those who define them import this module: the package fills it."""


def dispatch(commands: Commands, words: Arguments, program: str) -> None:
    """Run the subcommand that `words` name, or print what there is."""
    if not words or words[0] in ("-h", "--help"):
        print(_overview(commands, program))
        return
    if words[0] == "--version":
        from vd4rl_pomdp import __version__

        print(__version__)
        return
    if words[0] not in commands:
        raise UserError(f"unknown command '{program} {words[0]}': choose one of {', '.join(commands)}")
    entry = commands[words[0]]
    program = f"{program} {words[0]}"
    if isinstance(entry, Mapping):
        dispatch(entry, words[1:], program)
    elif len(words) > 1 and words[1] in entry.inner:
        entry.inner[words[1]].run(words[2:], f"{program} {words[1]}")
    else:
        entry.run(words[1:], program)


def _overview(commands: Commands, program: str) -> str:
    width = max(map(len, commands))
    lines = [f"usage: {program} COMMAND [--flags]   ({program} COMMAND --help says more)", ""]
    for name, entry in commands.items():
        text = ", ".join(entry) if isinstance(entry, Mapping) else entry.summary
        lines.append(f"  {name:<{width}}  {text}")
    return "\n".join(lines)


def run_stage(words: Arguments) -> None:
    """Do what `vd4rl-pomdp WORDS` does, in this process."""
    dispatch(COMMANDS, words, PROGRAM)
