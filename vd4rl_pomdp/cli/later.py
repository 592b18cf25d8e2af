"""Modules that a command needs only when it runs, not for its flags: `--help` then loads no torch."""

from __future__ import annotations

import builtins
import importlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


class _Later:
    """Stands for a module, which is imported when one of its names is first used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)


@contextmanager
def loaded_on_use() -> Iterator[None]:
    """Within the block, `from package import module` imports the module, and its package, at its first use.

    `from module import name` does not work there: write `module.name` below. `importlib.util.LazyLoader` is no choice:
    while torch is imported, it looks through `sys.modules` and would load all that waits there.
    """
    now = builtins.__import__

    def later(
        name: str,
        globals: Mapping[str, object] | None = None,
        locals: Mapping[str, object] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> Any:
        if fromlist and str((globals or {}).get("__name__")).startswith(__package__):
            return SimpleNamespace(**{module: _Later(f"{name}.{module}") for module in fromlist})
        return now(name, globals, locals, fromlist, level)  # of another thread

    builtins.__import__ = later
    try:
        yield
    finally:
        builtins.__import__ = now
