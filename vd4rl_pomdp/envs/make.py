"""Build a task's environment, and look up its layout (dimensions of actions and states)."""

from __future__ import annotations

from functools import cache

from vd4rl_pomdp.core.tasks import FRAME_SIZE, DMCTask, GymnasiumTask, Layout, Task
from vd4rl_pomdp.envs.pixels import PixelEnv, Render, check_render


def make_env(task: Task, render: Render = "fast", size: int | None = FRAME_SIZE, length: int | None = None) -> PixelEnv:
    """Build the environment of a task.

    `size` is the height and width S of the frames (None: no rendering), `length` the time limit in decisions (None: the
    task's). UserError for an environment that cannot be built.
    """
    check_render(render)
    if isinstance(task, GymnasiumTask):
        from vd4rl_pomdp.envs.gymnasium_task import GymnasiumEnv

        return GymnasiumEnv(task, size, length)
    assert isinstance(task, DMCTask), "the registry takes no other kind"
    from vd4rl_pomdp.envs.dmc import DMCEnv

    return DMCEnv(task, render, size, length)


def layout_of(task: Task) -> Layout:
    """A task's layout; if the task does not state it, its environment is built once to find out."""
    return _found(task) if task.layout is None else task.layout


@cache
def _found(task: Task) -> Layout:
    return make_env(task, size=None).layout
