"""Tasks whose target is visible only briefly: neither the first frames and actions nor present frames reveal it."""

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import FRAME_STACK, TASKS, DMCTask
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.check import check_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.envs.dmc import start_from
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.policies import load_actor

PLANS = {"reacher_jump": (2, 1), "point_mass_cue": (5, 85)}
"""Plans of two episodes: no jump, and one at decision 50; two cues at the same time."""
ROWS = 120
PLAN = 6
"""Column of the simulator state with the episode's plan."""


def play(env, start, actions):
    """All rows from a simulator state."""
    env.reset(0)  # dm_control treats the first step as a reset
    start_from(env.simulator, start)
    rows = [env._time_step(0.0, 1.0, StepType.FIRST)]
    for action in actions:
        reward, _, discount = env._apply(action)
        rows.append(env._time_step(reward, discount, StepType.MID))
    return rows


@pytest.fixture(scope="module", params=PLANS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def pair(name):
    """Two episodes with equal start and actions but different plans: (2, rows) time steps."""
    env = make_env(TASKS[name], size=32)
    start = env.reset(3).physics
    actions = np.random.default_rng(0).uniform(-1, 1, (ROWS, 2)).astype(np.float32)
    return [play(env, np.r_[start[:PLAN], plan, start[PLAN + 1 :]], actions) for plan in PLANS[name]]


def apart(pair, of):
    """(rows,) largest difference of a quantity between the rows of two episodes."""
    return np.array([np.abs(of(one).astype(float) - of(other)).max() for one, other in zip(*pair, strict=True)])


def test_glimpse_tasks_need_memory(name, pair):
    frame, state = apart(pair, lambda row: row.frame), apart(pair, lambda row: row.state)
    expert = load_actor(name, "expert")
    wanted = apart(pair, lambda row: expert.act(row.state))
    for found in (frame, state, wanted):
        assert not found[:FRAME_STACK].any()
    assert (wanted > 0.2).sum() > 30
    seen = np.convolve(frame > 0, np.ones(FRAME_STACK))[: len(frame)] > 0  # the row's frame stack differs
    assert seen.any()
    assert ((wanted > 0.2) & ~seen).sum() > 20
    assert not state[: seen.argmax()].any(), "the state reveals nothing before the glimpse"


def test_cue_is_visible_for_ten_decisions():
    env = make_env(TASKS["point_mass_cue"], size=32)
    rows = [env.reset(1)]
    while not rows[-1].last:
        rows.append(env.step(np.zeros(2, np.float32)))
    red = np.array([(row.frame[0].astype(int) - row.frame[2] > 60).sum() for row in rows])
    shown = np.flatnonzero(red > 8)
    assert 10 <= shown[0] <= 50
    np.testing.assert_array_equal(shown, shown[0] + np.arange(10))
    assert (np.delete(red, shown) < 3).all()
    places = np.unique([row.physics[2:4] for row in rows], axis=0)
    assert len(places) == 2
    assert not places.any(axis=1).all(), "the target starts in the centre"


def test_glimpse_episodes_replay_from_any_row(name, pair):
    env = make_env(TASKS[name], size=32)
    actions = np.random.default_rng(0).uniform(-1, 1, (ROWS, 2)).astype(np.float32)
    again = play(env, pair[1][40].physics, actions[40:])
    for row, first in zip(again[1:], pair[1][41:], strict=True):
        assert np.array_equal(row.frame, first.frame)
        np.testing.assert_allclose(row.physics, first.physics, atol=1e-9)
        assert row.reward == pytest.approx(first.reward, abs=1e-9)


@pytest.mark.parametrize("quality", ["random", "medium_expert"])
def test_glimpse_tasks_are_collected_and_replay(name, quality, tmp_path):
    collect(CollectConfig(name, quality, tmp_path / "set", episodes=2, workers=1, frame_size=16), 60)
    report = check_dataset(tmp_path / "set", tmp_path / "cache")
    assert (report["episodes"], report["replay_max_error"]) == (2, 0)


@pytest.mark.parametrize("domain", ["no.such_module", "vd4rl_pomdp.envs.glimpses", "vd4rl_pomdp.envs.make"])
def test_module_without_task_is_rejected(domain):
    with pytest.raises(UserError, match=f"^{domain} offers no task 'mine' in a SUITE"):
        make_env(DMCTask(domain, "mine"), size=None)
