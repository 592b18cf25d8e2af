import contextlib
import gc
import subprocess
import sys

import numpy as np
import pytest

from vd4rl_pomdp.envs import rendering
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.maze import MazeEnv
from vd4rl_pomdp.envs.rendering import suite
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.tasks import TASKS


@pytest.mark.parametrize("version", ["3.1.6", "3.2.7", "3.12.0", "4.0.0"])
def test_a_mujoco_that_was_not_tried_is_refused_with_what_to_install(version):
    with pytest.raises(UserError, match=r"pip install .*mujoco==3\.11\.0"):
        rendering.check_mujoco(version)


@pytest.mark.parametrize("version", ["3.3.0", "3.11.0", "3.11.2"])
def test_tried_versions_pass(version):
    rendering.check_mujoco(version)


def last_line(code: str) -> str:
    command = [sys.executable, "-c", f"{code}; import vd4rl_pomdp.envs.dmc"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stderr.splitlines()[-1]


def test_a_machine_without_opengl_gets_a_sentence(tmp_path):
    line = last_line("import os; os.environ['MUJOCO_GL'] = 'nothing'")
    assert "UserError: cannot render with MUJOCO_GL=nothing" in line
    assert "libegl1" in line
    (tmp_path / "mujoco.py").write_text("import ctypes\nraise ctypes.ArgumentError('no glGetError')")  # without libgl1
    line = last_line(f"import sys; sys.path.insert(0, {str(tmp_path)!r})")
    assert "UserError: cannot render with MUJOCO_GL=" in line
    assert "libgl1 " in line


def test_a_machine_without_dm_control_is_told_how_to_install_it():
    line = last_line("import sys; sys.modules['dm_control'] = None")
    assert line.endswith("UserError: dm-control is not installed: `pip install --no-deps dm-control==1.0.44`")


@pytest.mark.parametrize("task", TASKS)
def test_pictures_do_not_depend_on_the_size_of_the_buffer_they_are_drawn_in(task):
    env = make_env(TASKS[task], "exact")
    frame = env.reset(1).frame
    other = suite.load(TASKS[task].domain, TASKS[task].task).physics
    rendering.prepare(other, "exact", 480)
    start = env.physics.get_state()
    with other.reset_context():
        other.set_state(start)
    np.testing.assert_array_equal(rendering.FrameCamera(other).frame(), frame)


def test_a_picture_stays_what_it_was_when_the_next_one_is_drawn():
    env = make_env(TASKS["walker_walk"])
    first = env.reset(1).frame
    kept = first.copy()
    later = [env.step(np.ones(env.action_dim, np.float32)).frame for _ in range(5)]
    np.testing.assert_array_equal(first, kept)
    assert (later[-1] != first).any()
    assert first.flags.c_contiguous


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
