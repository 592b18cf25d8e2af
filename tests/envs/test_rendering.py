import contextlib
import gc
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask
from vd4rl_pomdp.envs import rendering
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.maze import MazeEnv


def test_untested_mujoco_versions_are_rejected():
    for version in ("3.3.0", "3.11.0", "3.17.0"):
        rendering.check_mujoco(version)
    for version in ("3.1.6", "3.2.7", "3.18.0", "4.0.0"):
        with pytest.raises(UserError, match=r"pip install .*mujoco==3\.11\.0"):
            rendering.check_mujoco(version)


@pytest.mark.parametrize("task", ["walker_walk", "reacher_jump"])
def test_incompatible_dm_control_is_reported(task, monkeypatch):
    def load(*arguments, **options):
        raise AttributeError("'MjModel' object has no attribute 'flex_evpair'")  # as of 1.0.44 with mujoco 3.17.0

    monkeypatch.setattr("dm_control.mujoco.Physics.from_xml_string", load)
    with pytest.raises(UserError, match=r"is incompatible with mujoco .*flex_evpair.*dm-control==1\.0\.44"):
        make_env(TASKS[task])


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


def test_missing_opengl_or_dm_control_is_reported():
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
"""The last command renders in spawned workers."""


def test_invalid_opengl_variables_are_reported_for_all_tasks(tmp_path):
    (tmp_path / "play.py").write_text(PLAY)
    words = [f"{command} --out {tmp_path / 'set'}" for command in COMMANDS]
    dropped = ("DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")  # the last is set once this process has rendered
    env = {name: value for name, value in os.environ.items() if name not in dropped}
    env |= {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "0,1"}
    command = [sys.executable, tmp_path / "play.py", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
    lines = done.stderr.splitlines()
    assert len(lines) == len(COMMANDS), lines
    for line in lines:
        assert re.match(r"error: cannot render with .*MUJOCO_EGL_DEVICE_ID=0,1.* \(.*\): correct or unset", line)


def test_rendering_process_exits_silently():
    code = (
        "from vd4rl_pomdp.envs.make import make_env; from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask\n"
        "names = 'HalfCheetah-v5', 'walker_walk'\n"
        "envs = [make_env(TASKS.get(name) or GymnasiumTask(name), size=16) for name in names]\n"
        "print(*(env.reset(0).frame.any() for env in envs))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.split(), done.stderr) == (["True", "True"], "")


@pytest.mark.parametrize("task", TASKS)
def test_frames_do_not_depend_on_the_buffer_size(task):
    env = make_env(TASKS[task], "exact")
    frame = env.reset(1).frame
    other = make_env(TASKS[task], size=None).physics
    rendering.prepare(other, "exact", 480)
    start = env.physics.get_state()
    with other.reset_context():
        other.set_state(start)
    np.testing.assert_array_equal(rendering.FrameCamera(other).frame(), frame)


@pytest.mark.parametrize("size", [None, 64, 800])
def test_other_skies_than_dm_controls_are_kept(size):
    sky = f'<texture type="skybox" builtin="flat" rgb1="1 0 0" width="{size}" height="{size}"/>' if size else ""
    floor = '<geom type="plane" size="1 1 1"/><camera name="c" pos="0 0 3"/>'
    physics = type(make_env(TASKS["walker_walk"], size=None).physics).from_xml_string(
        f"<mujoco><asset>{sky}</asset><worldbody>{floor}</worldbody></mujoco>"
    )
    before = physics.model.tex_data.copy()
    rendering.prepare(physics, "fast", 16)
    np.testing.assert_array_equal(physics.model.tex_data, before)


def three_frames(task, between=lambda: None):
    env = make_env(task)
    env.reset(1)
    frames = []
    for _ in range(3):
        between()
        frames.append(env.step(np.ones(env.action_dim, np.float32)).frame)
    return np.stack(frames), env


def new_walker(others):
    others.append(make_env(TASKS["walker_walk"]))
    others[-1].reset(1)


def new_maze(others):
    others.append(MazeEnv("three_curtains", render="exact"))
    others[-1].reset(seed=0)


def closed_maze(others):
    new_maze(others)
    others[-1].close()


@pytest.mark.parametrize(
    ("task", "disturb"),
    [
        (TASKS["walker_walk"], new_maze),
        (TASKS["walker_walk"], closed_maze),
        (GymnasiumTask("HalfCheetah-v5"), new_walker),
    ],
)
def test_frames_do_not_depend_on_other_renderers(task, disturb):
    """Each library knows only its own contexts, and would read a stale image."""
    others = []
    expected, _ = three_frames(task)
    assert (expected[0] != expected[-1]).any()
    np.testing.assert_array_equal(three_frames(task, lambda: disturb(others))[0], expected)


def draw_walker():
    frames, env = three_frames(TASKS["walker_walk"])
    return frames, type(env.physics.contexts.gl)


def draw_maze():
    env = MazeEnv("three_curtains", render="exact")
    env.reset(seed=0)
    return np.stack([env.step(np.ones(2, np.float32))[0] for _ in range(3)]), rendering.mujoco.GLContext


@pytest.mark.parametrize("draw", [draw_walker, draw_maze])
def test_frames_do_not_depend_on_freed_environments(draw, monkeypatch):
    """The garbage collector runs after a context was made current and before anything is rendered."""
    expected, context = draw()
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
    np.testing.assert_array_equal(draw()[0], expected)
