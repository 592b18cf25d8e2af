"""Environments: the data sets' tasks with the benchmark's corruptions, and the mazes.

Importing this package registers them with Gymnasium:

- Every task and corruption: `vd4rl_pomdp/WalkerWalk-v0`, `vd4rl_pomdp/WalkerWalk-Patch16-v0`,
  `vd4rl_pomdp/WalkerWalk-ZeroFrames-v0`, `vd4rl_pomdp/WalkerWalk-Patch16-ZeroFrames-v0`; likewise for `CheetahRun`,
  `HumanoidWalk`, `ReacherJump`, `PointMassCue` and other tasks registered before the import. For tasks registered
  later use `vd4rl_pomdp.envs.gym.GymEnv("its_name")`.
- The mazes: `vd4rl_pomdp/MazeNoCurtain-v0`, `MazeOneCurtain`, `MazeThreeCurtains`, `MazeFirstPerson` and variants.
- The paper's finite counterexample: `vd4rl_pomdp/ForwardJumpCounterexample-v0`.

Gymnasium's time limit truncates episodes (`gymnasium.make(..., max_episode_steps=100)` changes it); a step after the
end raises ResetNeeded. Tasks also accept `frame_size` (default 84) and the corruption's fields:
`gymnasium.make("vd4rl_pomdp/WalkerWalk-v0", corruption="patch", patch_size=24)`.
"""

import re
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs import opengl as opengl  # before anything that loads OpenGL
from vd4rl_pomdp.envs.mazes import MAZES

Info = dict[str, Any]
"""Gymnasium's `info` dict."""
_SUFFIXES = {"": "none", "-Patch16": "patch", "-ZeroFrames": "zero_frames", "-Patch16-ZeroFrames": "patch+zero_frames"}

GYM_IDS = {
    f"vd4rl_pomdp/{re.sub(r'[^A-Za-z0-9]', '', task.title())}{suffix}-v0": {"task": task, "corruption": corruption}
    for task in TASKS.registered()
    for suffix, corruption in _SUFFIXES.items()
}
"""Gymnasium id -> its task and corruption."""

FINITE_IDS = {"vd4rl_pomdp/ForwardJumpCounterexample-v0": "counterexample"}
"""Gymnasium id -> finite world."""
MAZE_STEPS, FINITE_STEPS = 500, 16
"""Time limits in actions of mazes and finite worlds."""


def _register(name: str, entry_point: str, arguments: dict[str, Any], steps: int) -> None:
    gymnasium.register(
        name,
        entry_point=f"vd4rl_pomdp.{entry_point}",
        kwargs=arguments,
        max_episode_steps=steps,
        additional_wrappers=(WrapperSpec("ResetAfterEnd", "vd4rl_pomdp.envs.pixels:ResetAfterEnd", {}),),
    )


for _id, _arguments in GYM_IDS.items():
    _register(_id, "envs.gym:GymEnv", _arguments, TASKS.registered()[_arguments["task"]].decisions)
for _id, _world in FINITE_IDS.items():
    _register(_id, "studies.theory.env:FiniteEnv", {"world": _world}, FINITE_STEPS)
for _maze in MAZES.values():
    _register(_maze.gym_id, "envs.maze:MazeEnv", {"maze": _maze.name}, MAZE_STEPS)
