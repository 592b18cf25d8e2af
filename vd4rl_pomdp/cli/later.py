"""Modules that a command needs only when it runs, not for its flags: `--help` then loads no torch."""

from __future__ import annotations

import importlib
from typing import Any


class Later:
    """Stands for a module, which is imported when one of its names is first used.

    Beside it, `if TYPE_CHECKING` has the import. `importlib.util.LazyLoader` is no choice: while torch is imported, it
    looks through `sys.modules` and would load all that waits there.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)
