"""Formats of other libraries by name, for `data import` and `data export`: one file each."""

from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.data.formats.base import DataFormat
from vd4rl_pomdp.data.formats.lerobot import LEROBOT, LEROBOT_VIDEO
from vd4rl_pomdp.data.formats.minari import MINARI
from vd4rl_pomdp.data.formats.ogbench import OGBENCH
from vd4rl_pomdp.data.formats.vd4rl import VD4RL, VD4RL_NPZ

FORMATS: Registry[DataFormat] = Registry(
    "format",
    {
        "lerobot": LEROBOT,
        "lerobot_video": LEROBOT_VIDEO,
        "minari": MINARI,
        "ogbench": OGBENCH,
        "vd4rl": VD4RL,
        "vd4rl_npz": VD4RL_NPZ,
    },
    lambda part: isinstance(part, DataFormat),
    "a vd4rl_pomdp.data.formats.base.DataFormat",
)
"""All formats. Other packages add theirs through the entry point group `vd4rl_pomdp.formats`."""
