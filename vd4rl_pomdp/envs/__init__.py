"""Environments: tasks as the data shows them, with the corruptions of the benchmark; and the mazes.

Importing this package registers every task and corruption with Gymnasium, as `vd4rl_pomdp/WalkerWalk-v0`,
`vd4rl_pomdp/WalkerWalk-Patch16-v0`, `vd4rl_pomdp/WalkerWalk-ZeroFrames-v0`,
`vd4rl_pomdp/WalkerWalk-Patch16-ZeroFrames-v0`, and likewise for `CheetahRun`, `HumanoidWalk`, `ReacherJump`,
`PointMassCue` and every other task that a call has registered by then (for others there is
`vd4rl_pomdp.envs.gym.GymEnv("its_name")`); the mazes as
`vd4rl_pomdp/MazeNoCurtain-v0`, `MazeOneCurtain`, `MazeThreeCurtains`, `MazeFirstPerson` and their variants; and the
paper's finite counterexample, `vd4rl_pomdp/ForwardJumpCounterexample-v0`.

Gymnasium's time limit truncates their episodes (`gymnasium.make(..., max_episode_steps=100)` chooses another); a step
after the end is refused. Tasks take the corruption's fields, too: `gymnasium.make("vd4rl_pomdp/WalkerWalk-v0",
corruption="patch", patch_size=24)`, and `frame_size`, 84 by default.
"""

import re
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.mazes import MAZES

Info = dict[str, Any]
"""Gymnasium's `info`: what an environment tells besides the observation."""
_SUFFIXES = {"": "none", "-Patch16": "patch", "-ZeroFrames": "zero_frames", "-Patch16-ZeroFrames": "patch+zero_frames"}

GYM_IDS = {
    f"vd4rl_pomdp/{re.sub(r'[^A-Za-z0-9]', '', task.title())}{suffix}-v0": {"task": task, "corruption": corruption}
    for task in TASKS.registered()
    for suffix, corruption in _SUFFIXES.items()
}
"""Every Gymnasium id, and the task and corruption it names."""

FINITE_IDS = {"vd4rl_pomdp/ForwardJumpCounterexample-v0": "counterexample"}
"""Finite worlds by Gymnasium id."""
MAZE_STEPS, FINITE_STEPS = 500, 16
"""Actions after which an episode in a maze or a finite world is truncated."""


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
