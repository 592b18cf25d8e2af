"""The settings of a run, which are its config without seed, folders, device and logging, and its labels.

Runs are seeds of one experiment only if their settings agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RUNTIME_FIELDS = frozenset(
    {
        "out",
        "device",
        "workers",
        "wandb",
        "tensorboard",
        "data",
        "encoder",
        "eval_clean",
        "log_every",
        "checkpoint_every",
    }
)
"""Config fields that do not change a result, so that a run may go on with other values; data and encoder may be moved,
and are compared by content; `eval_clean` adds rows that change no other."""
NO_SETTINGS = RUNTIME_FIELDS | {"seed"}
"""Config fields in which the seeds of one experiment may differ."""

LATER = {"future_frames": "all"}
"""Settings that earlier versions did not record, with what they did: having this value is the same as not having it."""

LABELS = ("method", "task", "quality", "corruption", "algorithm", "seed")
"""What names the rows of a run."""


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's config, as JSON keeps it, without NO_SETTINGS: the same for all seeds of an experiment."""
    told = {name: value for name, value in config.items() if name not in NO_SETTINGS}
    return {name: value for name, value in told.items() if name not in LATER or value != LATER[name]}
