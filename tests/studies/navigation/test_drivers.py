"""Planners and policies that collect maze data, compared with the paper's generator."""

from dataclasses import replace

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.maze import CELL_OFFSET, MazeEnv
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.studies.navigation.collect import _controller, _explore
from vd4rl_pomdp.studies.navigation.drivers import (
    FirstPersonConfig,
    Planner,
    WaypointPlanner,
    goals_reached,
    shipped_actor,
    train_first_person,
)


def test_planner_reaches_goals_in_all_cells():
    env = MazeEnv("hard_no_curtain", 5, pixels=False)
    planner = Planner(env)
    _, info = env.reset(seed=0)
    reached, places = 0, []
    for _ in range(600):
        _, reward, _, _, info = env.step(planner.act(info["state"], info["goal"]))
        reached += int(reward)
        places.append(info["state"][:2])
    assert reached > 20
    cells = {tuple(env.maze.cell_xy_to_rowcol(place)) for place in places}
    assert len(cells) == 7, "all cells of the U were visited"


def test_waypoint_planner_halts_in_every_cell():
    env = MazeEnv("no_curtain", 5, pixels=False)
    planner = WaypointPlanner(env, np.random.default_rng(0))
    env.reset(seed=0, options={"state": np.array([-1.0, 1.0, 0.0, 0.0])})
    env.goal = goal = np.array([-1.0, -1.0]) + CELL_OFFSET
    slowest = {}
    for _ in range(200):
        before = env.state[:2]
        _, reward, *_ = env.step(planner.act(env.state, goal))
        moved = np.linalg.norm(env.state[:2] - before)
        cell = tuple(np.round(env.state[:2] - CELL_OFFSET / 2))
        slowest[cell] = min(slowest.get(cell, np.inf), moved)
        if reward:
            break
    assert reward
    assert list(slowest) == [(-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]
    assert all(moved < WaypointPlanner.NEAR for moved in slowest.values()), slowest


def test_waypoints_lie_between_cell_centre_and_goal_point():
    env = MazeEnv("no_curtain", 5, pixels=False)
    env.reset(seed=0)
    ahead = []
    for seed in range(50):
        planner = WaypointPlanner(env, np.random.default_rng(seed))
        planner.act(np.array([-1.0, 1.0, 0.0, 0.0]), np.array([1.2, -0.2]))
        ahead.append(planner._ahead)
    centers = np.array([(0, 1), (1, 1)])
    beside = (np.array(ahead)[:, :2] - centers) * np.sign(CELL_OFFSET)
    assert beside.min() >= 0
    assert beside.max() <= 0.2
    assert np.ptp(beside, axis=0).min() > 0.15
    np.testing.assert_array_equal(np.array(ahead)[:, 2], np.tile([1.2, -0.2], (50, 1)))


def drive(maze: str, seeds: int) -> np.ndarray:
    """States (seeds x 1500, P) of unrendered trajectories."""
    env, states = MazeEnv(maze, pixels=False), []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        act, (_, info) = _controller(env, rng), env.reset(seed=seed)
        for _ in range(1500):
            *_, info = env.step(_explore(act(info["state"], info["goal"]), env.maze_spec.style, rng))
            states.append(info["state"])
    return np.array(states)


@pytest.fixture(scope="module")
def top() -> np.ndarray:
    """(N, 4) states visited by the paper's planner."""
    return drive("three_curtains", 6)


def test_curtains_hide_the_expected_share_of_states(top):
    """The paper reports about 22%, which is reached here if a seventh of the ball's radius may be visible."""
    three = MAZES["three_curtains"]
    assert three.hidden(top).mean() == pytest.approx(0.185, abs=0.02)
    nearly = replace(three, style=replace(three.style, hidden_reach=0.17))
    assert nearly.hidden(top).mean() == pytest.approx(0.22, abs=0.02)
    hard = drive("hard_three_curtains", 4)
    assert MAZES["hard_three_curtains"].hidden(hard).mean() == pytest.approx(0.36, abs=0.04)


def test_uninformed_velocity_error_matches_the_paper(top):
    """The paper's velocity errors of No History, 91.5 to 91.9, are only possible in raw units."""
    velocity = top[:, 2:]
    ignorance = np.abs(velocity - velocity.mean(0)).mean(0)
    assert 100 * ignorance.mean() == pytest.approx(91.5, rel=0.15)
    assert 100 * (ignorance / velocity.std(0)).max() < 80
    assert (np.abs(velocity) > 5).any(), "velocities are limited once a decision"
    assert np.abs(velocity).max() < 6.2
    np.testing.assert_allclose(velocity.std(0), 1.5, atol=0.15)


@pytest.mark.parametrize("maze", ["first_person", "hard_first_person"])
def test_shipped_first_person_policy_reaches_goals(maze):
    actor = shipped_actor(MAZES[maze])
    assert actor.card["algorithm"] == "PPO"
    reached = goals_reached(actor, maze, actor.card["action_repeat"], 3)
    idle = replace(actor, weights={name: value * 0 for name, value in actor.weights.items()})
    assert reached >= 11
    assert goals_reached(idle, maze, actor.card["action_repeat"], 3) < reached / 3


def test_ppo_actor_round_trip(tmp_path):
    trained = train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", decisions=2000))
    stored = read_actor(tmp_path / "actor.safetensors")
    seen = np.array([0.3, -0.2, 1.0, 0.1], np.float32)
    np.testing.assert_array_equal(stored.act(seen), trained.act(seen))
    assert stored.card["decisions"] == 2048, "whole rounds of PPO"
    spread = [stored.act(seen, np.random.default_rng(i)) for i in range(50)]
    assert np.std(spread, axis=0).min() > 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"maze": "no_curtain"}, "--maze is no_curtain, where a planner drives"),
        ({"decisions": 0}, "--decisions is 0"),
        ({}, r"actor\.safetensors: exists already"),
    ],
)
def test_invalid_policy_settings_are_rejected(tmp_path, changes, message):
    (tmp_path / "actor.safetensors").write_text("mine\n")
    with pytest.raises(UserError, match=message):
        train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", **changes))
    assert (tmp_path / "actor.safetensors").read_text() == "mine\n"


def test_policy_training_does_not_replace_a_dangling_link(tmp_path):
    (tmp_path / "actor.safetensors").symlink_to("nothing")
    with pytest.raises(UserError, match=r"actor\.safetensors: exists already"):
        train_first_person(FirstPersonConfig(tmp_path / "actor.safetensors", decisions=1))
