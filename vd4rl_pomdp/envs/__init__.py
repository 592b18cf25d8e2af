"""Environments: dm_control pixels as the data shows them, with the corruptions of the benchmark; and four mazes.

Importing this package registers every task and corruption with Gymnasium, as `vd4rl_pomdp/WalkerWalk-v0`,
`vd4rl_pomdp/WalkerWalk-Patch16-v0`, `vd4rl_pomdp/WalkerWalk-ZeroFrames-v0`,
`vd4rl_pomdp/WalkerWalk-Patch16-ZeroFrames-v0`, and likewise for `CheetahRun` and `HumanoidWalk`; the mazes as
`vd4rl_pomdp/MazeNoCurtain-v0`, `MazeOneCurtain`, `MazeThreeCurtains` and `MazeFirstPerson`; and the paper's finite
counterexample, `vd4rl_pomdp/ForwardJumpCounterexample-v0`.
"""

import gymnasium

from vd4rl_pomdp.mazes import MAZES
from vd4rl_pomdp.tasks import TASKS

_SUFFIXES = {"": "none", "-Patch16": "patch", "-ZeroFrames": "zero_frames", "-Patch16-ZeroFrames": "patch+zero_frames"}

GYM_IDS = {
    f"vd4rl_pomdp/{task.title().replace('_', '')}{suffix}-v0": {"task": task, "corruption": corruption}
    for task in TASKS
    for suffix, corruption in _SUFFIXES.items()
}
"""Every Gymnasium id, and the task and corruption it names."""

for _id, _arguments in GYM_IDS.items():
    gymnasium.register(_id, entry_point="vd4rl_pomdp.envs.gym:GymEnv", kwargs=_arguments)

FINITE_IDS = {"vd4rl_pomdp/ForwardJumpCounterexample-v0": "counterexample"}
"""Finite worlds by Gymnasium id."""

for _id, _world in FINITE_IDS.items():
    gymnasium.register(_id, entry_point="vd4rl_pomdp.envs.finite:FiniteEnv", kwargs={"world": _world})

MAZE_STEPS = 500
"""Actions after which a registered maze truncates its episode."""

for _maze in MAZES.values():
    gymnasium.register(
        _maze.gym_id,
        entry_point="vd4rl_pomdp.envs.maze:MazeEnv",
        kwargs={"maze": _maze.name},
        max_episode_steps=MAZE_STEPS,
    )
