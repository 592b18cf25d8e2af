import numpy as np

from vd4rl_pomdp.envs.maze import CELL_OFFSET, MazeEnv
from vd4rl_pomdp.studies.navigation.drivers import Planner, WaypointPlanner


def test_the_planner_reaches_goals_everywhere():
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


def test_the_papers_planner_halts_beside_every_centre_on_its_way():
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


def test_waypoints_lie_between_the_centre_of_a_cell_and_its_point():
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


def test_a_waypoint_is_passed_at_walking_pace_only():
    env = MazeEnv("no_curtain", 5, pixels=False)
    env.reset(seed=0)
    goal = np.array([1.2, -0.2])
    for travel, passed in ((0.2, 0), (0.05, 1)):
        planner = WaypointPlanner(env, np.random.default_rng(0))
        planner.act(np.array([-1.0, 1.0, 0.0, 0.0]), goal)
        waypoint, left = planner._ahead[0], len(planner._ahead)
        for place in (waypoint - [0, 0.09 + travel], waypoint - [0, 0.09]):
            planner.act(np.array([*place, 0.0, 0.0]), goal)
        assert left - len(planner._ahead) == passed, travel
