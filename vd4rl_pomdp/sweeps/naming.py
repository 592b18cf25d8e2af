"""Folders of a sweep's runs: TASK/QUALITY/CORRUPTION/METHOD/seedN, and what else tells a cell from others."""

from __future__ import annotations

from typing import Any

from vd4rl_pomdp.runs.identity import content_hash
from vd4rl_pomdp.sweeps.grid import GridCell

_LONGEST = 160
"""Bytes of settings in a folder's name, which has room for 255 in all."""
_OWN = {
    "collect": ("task", "quality"),
    "pretrain": ("method", "corruption"),
    "finetune": ("algorithm",),
    "navigation_collect": ("maze",),
    "navigation_train": ("method",),
}
"""Settings that have a place of their own in a folder's name."""


def extras(cell: GridCell, section: str) -> str:
    """The other settings of a section that tell a cell from others: ",history=gru,max_k=1"; or their hash."""
    named = [name for name in cell.named.get(section, ()) if name not in _OWN[section]]
    told = "".join(f",{name}={_word(cell.sections[section][name])}" for name in named)
    return told if len(told.encode()) <= _LONGEST else f",{content_hash(told)}"


def run_folder(cell: GridCell, section: str, data: str, values: dict[str, Any]) -> str:
    """Where a run goes, below the sweep's folder.

    Args:
        cell: the run's.
        section: its stage.
        data: name of its set.
        values: settings of all its stages by name, defaults included.
    """
    if section == "navigation_train":
        return f"{data}/{values['method']}{extras(cell, section)}/seed{cell.seed}"
    shared = f"{data}/{values['corruption']}/{values['method']}{extras(cell, 'pretrain')}/seed{cell.seed}"
    if section == "pretrain":
        return f"{shared}/pretrain"
    return f"{shared}/finetune-{values['algorithm']}{extras(cell, section)}"


def _word(value: Any) -> str:
    return str(value).replace("/", "_")
