"""Settings of `vd4rl-pomdp navigation collect` and its presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from vd4rl_pomdp.envs.mazes import ACTION_REPEAT


@dataclass(frozen=True)
class MazeCollectConfig:
    """Settings of `vd4rl-pomdp navigation collect`."""

    maze: str
    """no_curtain, one_curtain, three_curtains or first_person; compass_first_person; or one of the four after hard_."""
    out: Path
    """Folder of the set."""
    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""
    trajectories: int = 500
    """Trajectories in all; the last tenth is held out from training."""
    trajectory_rows: int = 1000
    """Rows of each trajectory."""
    action_repeat: int = ACTION_REPEAT
    """Simulator steps of 0.01 s for one action."""
    seed: int = 0
    """Seed of starts, goals and what is random about actions."""
    workers: int = 0
    """Processes that simulate and draw; 0 uses every core."""
    trajectories_per_shard: int = 5
    """Trajectories in a shard."""


_CPU = MazeCollectConfig("", Path(), preset="cpu", trajectories=100)
PRESETS = {
    "paper": MazeCollectConfig("", Path()),
    "cpu": _CPU,
    "smoke": replace(_CPU, preset="smoke", trajectories=10, trajectory_rows=120),
}
"""Defaults by preset: 500k rows as in the paper, 100k, and 1,200 rows."""
