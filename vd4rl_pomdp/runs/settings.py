"""Which settings of a run can change its result: all but its seed, its folders, its device and its logging.

Runs are seeds of one experiment only if these agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

NO_SETTINGS = frozenset(
    {
        "seed",
        "data",
        "encoder",
        "out",
        "device",
        "workers",
        "wandb",
        "log_every",
        "checkpoint_every",
        "resume_every",
    }
)
"""Config fields that are no settings. Data and encoder are folders: what lies in them is compared by its own record."""


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's config, as JSON keeps it, without the fields that do not change a result."""
    return {name: value for name, value in config.items() if name not in NO_SETTINGS}
