"""Corruptions that make observations partial."""

from vd4rl_pomdp.corruptions.corruption import (
    CORRUPTIONS,
    NO_CORRUPTION,
    STAGES,
    BatchCorruption,
    Corruption,
    CorruptionConfig,
    FrameDrop,
    Patch,
    Stage,
    Truncate,
    ZeroFrames,
    check_corruption_fits,
    corruption_settings,
    make_corruption,
)
from vd4rl_pomdp.corruptions.keys import KeyStream, derive_keys, draw_integers

__all__ = [
    "CORRUPTIONS",
    "NO_CORRUPTION",
    "STAGES",
    "BatchCorruption",
    "Corruption",
    "CorruptionConfig",
    "FrameDrop",
    "KeyStream",
    "Patch",
    "Stage",
    "Truncate",
    "ZeroFrames",
    "check_corruption_fits",
    "corruption_settings",
    "derive_keys",
    "draw_integers",
    "make_corruption",
]
