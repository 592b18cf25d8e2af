"""Run by `test_processes`: vector environments before and after the parent has rendered, then an optimiser."""

import importlib.util
import sys

import gymnasium
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask

TASKS.register("half_cheetah", GymnasiumTask("HalfCheetah-v5"))

import vd4rl_pomdp.envs  # noqa: E402, F401 (registers the ids)

TASK, MAZE = "vd4rl_pomdp/WalkerWalk-Patch16-ZeroFrames-v0", "vd4rl_pomdp/MazeOneCurtain-v0"
GYMNASIUM = "vd4rl_pomdp/HalfCheetah-v0"


def walk(name: str, start: str) -> None:
    envs = gymnasium.make_vec(name, 1, "async", vector_kwargs={"context": start})
    try:
        obs, _ = envs.reset(seed=0)
        assert obs.any()
        envs.step(envs.action_space.sample())
    finally:
        envs.close(terminate=True)


def refused(name: str) -> bool:
    try:
        walk(name, "fork")
    except UserError as error:
        return "vector_kwargs={'context': 'spawn'}" in str(error) and len(str(error).splitlines()) == 1
    return False


if __name__ == "__main__":
    torch.set_num_threads(2)
    torch.rand(1000, 1000).exp().sum()  # starts two threads, which a forked process does not inherit
    for name in (TASK, MAZE, GYMNASIUM):
        walk(name, "fork")
    gymnasium.make(TASK).reset(seed=0)
    assert all(refused(name) for name in (TASK, MAZE, GYMNASIUM))
    walk(TASK, "spawn")  # inherits nothing, so one kind of environment suffices
    # An optimiser imports Triton: if Mesa had loaded its LLVM first, this would be a segmentation fault.
    torch.optim.Adam([torch.zeros(1, requires_grad=True)])
    assert importlib.util.find_spec("triton") is None or "triton" in sys.modules
    print("as expected")
