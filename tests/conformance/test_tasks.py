"""All tasks satisfy the contract of tasks; violations are caught."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from tests.helpers_envs import Counter
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, DMCTask, GymnasiumTask, Layout
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.envs import dmc
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.envs.gym import GymEnv
from vd4rl_pomdp.envs.gymnasium_task import GymnasiumEnv
from vd4rl_pomdp.envs.pixels import PixelEnv
from vd4rl_pomdp.testing import check_task
from vd4rl_pomdp.testing import tasks as checks
from vd4rl_pomdp.testing.contract import run_check


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", TASKS)
def test_task_conforms(name, check):
    run_check("task", check, name)


class Unseeded(Counter):
    """Shows the number of its episode."""

    episode = 0

    def reset(self, **given):
        self.episode += 1
        return super().reset(**given)

    def picture(self):
        return np.full(self.shape, self.episode, np.uint8)


class Failing(Counter):
    def step(self, action):
        raise RuntimeError("the motor is off")


class Strict(Counter):
    """Rejects actions outside its bounds, which are not exact in binary, or of another dtype."""

    def __init__(self, **given):
        space = gymnasium.spaces.Box(np.array([-0.1, 1.5]), np.array([0.7, 1.86]), dtype=np.float64)
        super().__init__(space=space, **given)

    def step(self, action):
        assert action.dtype == np.float64
        assert self.action_space.contains(action), action.tolist()
        return super().step(action)


WALKER = TASKS["walker_walk"]
COUNTER = GymnasiumTask(Counter)
STEP = PixelEnv.step
MUTANTS = [
    (GymnasiumTask(Unseeded), checks.episodes_repeat_from_their_seeds, "row 0 differs in frame or state"),
    (
        GymnasiumTask(Counter, layout=Layout(3)),
        checks.rows_have_the_declared_widths,
        "its layout says .* the environment has",
    ),
    (replace(WALKER, layout=Layout(6, 23, 9, travel=(1,))), checks.rows_have_the_declared_widths, "its layout says"),
    (GymnasiumTask(Failing), checks.episodes_end_once, "RuntimeError: the motor is off"),
    (COUNTER, checks.rows_have_the_declared_widths, "a reward is inf"),
    (COUNTER, checks.episodes_end_once, "does not end"),
    (WALKER, checks.rewards_replay, "and replay as"),
]
BROKEN = {
    "a reward is inf": (GymnasiumEnv, "_apply", lambda self, action: (np.inf, False, 1.0)),
    "does not end": (PixelEnv, "step", lambda self, action: replace(STEP(self, action), step_type=1)),
    "and replay as": (dmc, "replay_rewards", lambda name, physics, actions: np.zeros(len(actions))),
}
"""Defects of the harness, by the reason that the check then gives."""


@pytest.mark.parametrize(("task", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_tasks_are_caught(task, check, reason, monkeypatch):
    if reason in BROKEN:
        monkeypatch.setattr(*BROKEN[reason])
    TASKS.register("mine", task)
    with pytest.raises(AssertionError, match=f"task 'mine' violates its contract(.|\n)*{reason}"):
        run_check("task", check, "mine")


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
