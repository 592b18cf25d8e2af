"""From a task to its environment, and to the widths of what its rows hold."""

from __future__ import annotations

from functools import cache

from vd4rl_pomdp.core.tasks import FRAME_SIZE, DMCTask, GymnasiumTask, Layout, Task
from vd4rl_pomdp.envs.pixels import PixelEnv, Render, check_render


def make_env(task: Task, render: Render = "fast", size: int | None = FRAME_SIZE, length: int | None = None) -> PixelEnv:
    """The environment of a task.

    Args:
        task: what is played.
        render: how dm_control draws.
        size: height and width S of the frames; None: nothing is drawn.
        length: decisions after which an episode is cut off; None: the task's own.

    Raises:
        UserError: the environment cannot be built, or is of a kind that the harness cannot play.
    """
    check_render(render)
    if isinstance(task, GymnasiumTask):
        from vd4rl_pomdp.envs.gymnasium_task import GymnasiumEnv

        return GymnasiumEnv(task, size, length)
    assert isinstance(task, DMCTask), "the registry takes no other kind"
    from vd4rl_pomdp.envs.dmc import DMCEnv

    return DMCEnv(task, render, size, length)


def layout_of(task: Task) -> Layout:
    """A task's layout as given, else as its environment has it, which is built for that once."""
    return _found(task) if task.layout is None else task.layout


@cache
def _found(task: Task) -> Layout:
    return make_env(task, size=None).layout
