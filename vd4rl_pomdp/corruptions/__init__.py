"""Corruptions that make the observations partial."""

from vd4rl_pomdp.corruptions.corruption import (
    CORRUPTIONS,
    STAGES,
    BatchCorruption,
    Corruption,
    CorruptionConfig,
    Patch,
    Stage,
    check_corruption,
    make_corruption,
)
from vd4rl_pomdp.corruptions.keys import KeyStream, derive_keys, draw_integers

__all__ = [
    "CORRUPTIONS",
    "STAGES",
    "BatchCorruption",
    "Corruption",
    "CorruptionConfig",
    "KeyStream",
    "Patch",
    "Stage",
    "check_corruption",
    "derive_keys",
    "draw_integers",
    "make_corruption",
]
