"""`vd4rl-pomdp list`: everything that has a name, by kind, that of installed packages included."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse
from vd4rl_pomdp.core.errors import flag_of
from vd4rl_pomdp.core.registry import REGISTRIES, Registry


@dataclass(frozen=True)
class ListCommand:
    """List methods, corruptions, algorithms, frame encoders, memories and tasks, one line each."""


def _list(words: Arguments, program: str) -> None:
    parse(ListCommand, words, program)
    import finetune.algorithms  # noqa: F401 (a kind's registry is made where its parts are)
    import pretrain.objectives  # noqa: F401
    import vd4rl_pomdp.core.tasks  # noqa: F401

    for setting, registry in sorted(REGISTRIES.items()):
        print(f"{flag_of(setting)}   (packages offer theirs as entry points of {registry.group})")
        print("\n".join(_lines(registry)), end="\n\n")


def _lines(registry: Registry[Any]) -> Iterator[str]:
    """One line for each part of a kind, and for each that an installed package offers in vain."""
    names = [*registry, *registry.broken]
    width = max(map(len, names))
    for name, part in registry.items():
        origin = f"   [{registry.origin(name)}]" if registry.origin(name) else ""
        yield f"  {name:<{width}}  {summary_of(part)}{origin}".rstrip()
    for name, reason in registry.broken.items():
        yield f"  {name:<{width}}  cannot be loaded: {reason}"


def summary_of(part: Any) -> str:
    """What a part says of itself in a line: its `summary`, or the first line of its docstring."""
    text = getattr(part, "summary", "") or getattr(part, "build", part).__doc__ or ""  # its own, no base class's
    return text.strip().partition("\n")[0].removesuffix(".")


LIST = Command("methods, corruptions, algorithms, frame encoders, memories and tasks, one line each", _list)
