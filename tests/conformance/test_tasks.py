"""All tasks satisfy the contract of tasks; violations are caught."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, DMCTask, GymnasiumTask, Layout
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.envs import dmc
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.envs.gym import GymEnv
from vd4rl_pomdp.testing import check_task
from vd4rl_pomdp.testing import tasks as checks
from vd4rl_pomdp.testing.contract import run_check


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", TASKS)
def test_task_conforms(name, check):
    run_check("task", check, name)


class Square(gymnasium.Env):
    """A valid environment that shows and returns a number drawn from its seed; subclasses break the contract."""

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0, 255, (1,))
        self.action_space = gymnasium.spaces.Box(-2.0, 3.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.number = self.draw()
        return np.array([self.number]), {}

    def draw(self):
        return int(self.np_random.integers(256))

    def step(self, action):
        return np.array([self.number]), float(self.number), False, False, {}

    def render(self):
        return np.full((90, 90), self.number, np.uint8)


class Unseeded(Square):
    def draw(self):
        self.drawn = getattr(self, "drawn", 0) + 1
        return self.drawn


class Failing(Square):
    def step(self, action):
        raise RuntimeError("the motor is off")


class Strict(Square):
    """Rejects actions outside its bounds, which are not exact in binary, or of another dtype."""

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Box(np.array([-0.1, 1.5]), np.array([0.7, 1.86]), dtype=np.float64)

    def step(self, action):
        assert action.dtype == np.float64
        assert self.action_space.contains(action), action.tolist()
        return super().step(action)


WALKER = TASKS["walker_walk"]
MUTANTS = [
    (GymnasiumTask(Unseeded), checks.episodes_repeat_from_their_seeds, "row 0 differs in frame or state"),
    (
        GymnasiumTask(Square, layout=Layout(3)),
        checks.rows_have_the_declared_widths,
        "its layout says .* the environment has",
    ),
    (replace(WALKER, layout=Layout(6, 23, 9, travel=(1,))), checks.rows_have_the_declared_widths, "its layout says"),
    (GymnasiumTask(Failing), checks.episodes_end_once, "RuntimeError: the motor is off"),
]


@pytest.mark.parametrize(("task", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_tasks_are_caught(task, check, reason):
    TASKS.register("mine", task)
    with pytest.raises(AssertionError, match=f"task 'mine' violates its contract(.|\n)*{reason}"):
        run_check("task", check, "mine")


def test_harness_defects_are_caught(monkeypatch):
    from vd4rl_pomdp.envs.gymnasium_task import GymnasiumEnv
    from vd4rl_pomdp.envs.pixels import PixelEnv

    TASKS.register("mine", GymnasiumTask(Square))
    step, frame = PixelEnv.step, GymnasiumEnv._frame
    buffer = np.zeros((3, 84, 84), np.uint8)

    def drawn_into_one_buffer(self, size):
        buffer[:] = frame(self, size)
        return buffer

    broken = [
        (
            GymnasiumEnv,
            "_rescaled",
            lambda self, a: a * 5,
            checks.actions_fill_their_bounds,
            "becomes .* the bounds are",
        ),
        (
            GymnasiumEnv,
            "_rescaled",
            lambda self, a: a.astype(np.float64) * 2.5 + 0.5,
            checks.actions_fill_their_bounds,
            "are float64, its bounds float32",
        ),
        (
            GymnasiumEnv,
            "_frame",
            lambda self, s: frame(self, s + 1),
            checks.frames_have_the_size_asked_for,
            "of size 84 is",
        ),
        (GymnasiumEnv, "_frame", drawn_into_one_buffer, checks.frames_stay_as_they_were, "row 0 changes in later rows"),
        (
            GymnasiumEnv,
            "_apply",
            lambda self, a: (np.inf, False, 1.0),
            checks.rows_have_the_declared_widths,
            "a reward is inf",
        ),
        (
            PixelEnv,
            "step",
            lambda self, a: replace(step(self, a), step_type=1),
            checks.episodes_end_once,
            "does not end",
        ),
        (dmc, "replay_rewards", lambda n, p, a: np.zeros(len(a)), checks.rewards_replay, "and replay as"),
    ]
    for place, name, instead, check, reason in broken:
        with monkeypatch.context() as patch:
            patch.setattr(place, name, instead)
            with pytest.raises(AssertionError, match=reason):
                run_check("task", check, "walker_walk" if place is dmc else "mine")


def test_check_task_accepts_conforming_tasks():
    TASKS.register("strict", GymnasiumTask(Strict, decisions=5))
    TASKS.register("reacher", DMCTask("reacher", "easy"))  # draws a random target, so it cannot be replayed
    check_task("strict")
    check_task("reacher")
    with pytest.raises(UserError, match="unknown task 'mine'"):
        check_task("mine")


@pytest.mark.parametrize("task", ["lqr_2_1", "lqr_6_2"])
def test_unbounded_dm_control_tasks_are_rejected(tmp_path, task):
    TASKS.register("unbounded", DMCTask("lqr", task))
    message = f"dm_control's lqr {task} has actions from -1e[+]10 to 1e[+]10: only bounds within -1e[+]09 and 1e[+]09"
    for play in (
        lambda: check_task("unbounded"),
        lambda: collect(CollectConfig("unbounded", "random", tmp_path / "set", episodes=1, workers=1)),
        lambda: GymEnv("unbounded"),
        lambda: CorruptedEnv(TASKS["unbounded"], CorruptionConfig.of("none")),
        lambda: dmc.replay_rewards("unbounded", np.zeros(4), np.zeros((1, 1))),
    ):
        with pytest.raises(UserError, match=message):
            play()
    assert not (tmp_path / "set").exists()
