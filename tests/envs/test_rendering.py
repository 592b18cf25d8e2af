import contextlib
import gc
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs import rendering
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.maze import MazeEnv


def test_a_mujoco_that_was_not_tried_is_refused_with_what_to_install():
    for version in ("3.3.0", "3.11.0", "3.17.0"):
        rendering.check_mujoco(version)
    for version in ("3.1.6", "3.2.7", "3.18.0", "4.0.0"):
        with pytest.raises(UserError, match=r"pip install .*mujoco==3\.11\.0"):
            rendering.check_mujoco(version)


@pytest.mark.parametrize("task", ["walker_walk", "reacher_jump"])
def test_a_dm_control_of_another_mujoco_is_one_line(task, monkeypatch):
    def load(*arguments, **options):
        raise AttributeError("'MjModel' object has no attribute 'flex_evpair'")  # as of 1.0.44 with mujoco 3.17.0

    monkeypatch.setattr("dm_control.mujoco.Physics.from_xml_string", load)
    with pytest.raises(UserError, match=r"is incompatible with mujoco .*flex_evpair.*dm-control==1\.0\.44") as caught:
        make_env(TASKS[task])
    assert "\n" not in str(caught.value)


WITHOUT = """
import os, sys
from vd4rl_pomdp.core.errors import UserError

def load():
    try:
        import vd4rl_pomdp.envs.dmc
    except UserError as error:
        print(error)

os.environ["MUJOCO_GL"] = "nothing"
load()
os.environ["MUJOCO_GL"], sys.modules["dm_control"] = "egl", None
load()
"""


def test_a_machine_without_opengl_or_dm_control_gets_a_sentence():
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True, check=True)
    opengl, control = done.stdout.splitlines()
    assert re.match("cannot render with .*MUJOCO_GL=nothing.*libegl1", opengl)
    assert control == "dm-control is not installed: `pip install --no-deps dm-control==1.0.44`"


PLAY = """
import os, sys
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask

TASKS.register("cheetah", GymnasiumTask("HalfCheetah-v5", decisions=2))
if __name__ == "__main__":
    for words in sys.argv[1:]:
        try:
            main(words.split())
        except SystemExit as end:
            assert end.code == 2
"""
COMMANDS = [
    "data collect --task walker_walk --quality random --frame-size 16 --episodes 1 --workers 1",
    "data collect --task cheetah --quality random --frame-size 16 --episodes 1 --workers 1",
    "navigation collect --maze no_curtain --preset smoke --workers 1",
    "data collect --task walker_walk --quality random --frame-size 16 --episodes 2 --workers 2",
]
"""The last one draws in spawned workers."""


def test_a_variable_that_opengl_cannot_use_is_one_line_for_every_kind_of_task(tmp_path):
    (tmp_path / "play.py").write_text(PLAY)
    words = [f"{command} --out {tmp_path / 'set'}" for command in COMMANDS]
    dropped = ("DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")  # the last is set where this process has drawn
    env = {name: value for name, value in os.environ.items() if name not in dropped}
    env |= {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "0,1"}
    command = [sys.executable, tmp_path / "play.py", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
    lines = done.stderr.splitlines()
    assert len(lines) == len(COMMANDS), lines
    for line in lines:
        assert re.match(r"error: cannot render with .*MUJOCO_EGL_DEVICE_ID=0,1.* \(.*\): correct or unset", line)


def test_a_process_that_has_drawn_ends_without_a_word():
    code = (
        "from vd4rl_pomdp.envs.make import make_env; from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask\n"
        "names = 'HalfCheetah-v5', 'walker_walk'\n"
        "envs = [make_env(TASKS.get(name) or GymnasiumTask(name), size=16) for name in names]\n"
        "print(*(env.reset(0).frame.any() for env in envs))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.split(), done.stderr) == (["True", "True"], "")


@pytest.mark.parametrize("task", TASKS)
def test_pictures_do_not_depend_on_the_size_of_the_buffer_they_are_drawn_in(task):
    env = make_env(TASKS[task], "exact")
    frame = env.reset(1).frame
    other = make_env(TASKS[task], size=None).physics
    rendering.prepare(other, "exact", 480)
    start = env.physics.get_state()
    with other.reset_context():
        other.set_state(start)
    np.testing.assert_array_equal(rendering.FrameCamera(other).frame(), frame)


def three_frames(env, between=lambda: None):
    env.reset(1)
    frames = []
    for _ in range(3):
        between()
        frames.append(env.step(np.ones(env.action_dim, np.float32)).frame)
    return np.stack(frames)


@pytest.mark.parametrize("closed", [False, True])
def test_another_renderer_in_the_process_changes_no_picture(closed):
    """mujoco's own, whose context dm_control does not know of: it drew nothing and read the picture before."""
    mazes = []

    def draw_a_maze():
        mazes.append(MazeEnv("three_curtains", render="exact"))
        mazes[-1].reset(seed=0)
        if closed:
            mazes[-1].close()

    alone = three_frames(make_env(TASKS["walker_walk"]))
    np.testing.assert_array_equal(three_frames(make_env(TASKS["walker_walk"]), draw_a_maze), alone)


def draw_walker():
    env = make_env(TASKS["walker_walk"])
    return three_frames(env), type(env.physics.contexts.gl)


def draw_maze():
    env = MazeEnv("three_curtains", render="exact")
    env.reset(seed=0)
    return np.stack([env.step(np.ones(2, np.float32))[0] for _ in range(3)]), rendering.mujoco.GLContext


@pytest.mark.parametrize("draw", [draw_walker, draw_maze])
def test_an_environment_that_is_freed_while_another_draws_changes_no_picture(draw, monkeypatch):
    """The garbage collector at its worst moment: a context has been made current, and nothing drawn yet."""
    alone, context = draw()
    make_current = context.make_current
    garbage = [make_env(TASKS["cheetah_run"])]
    garbage[0].reset(1)

    def then_collect(self):
        made = make_current(self)
        return within(made) if isinstance(made, contextlib.AbstractContextManager) else collect()

    @contextlib.contextmanager
    def within(made):
        with made as thread:
            collect()
            yield thread

    def collect():
        if gc.isenabled():
            garbage.clear()

    monkeypatch.setattr(context, "make_current", then_collect)
    np.testing.assert_array_equal(draw()[0], alone)
