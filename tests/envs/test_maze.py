import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import vd4rl_pomdp.envs
from vd4rl_pomdp.envs.maze import MazeEnv
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.mazes import MAZES, get_maze


def states_of(maze: str, count: int, hidden: bool, env: MazeEnv, rng: np.random.Generator) -> list[np.ndarray]:
    """Free states with random velocities, wholly under a curtain or not."""
    found: list[np.ndarray] = []
    while len(found) < count:
        state = np.concatenate([rng.uniform(-1.5, 1.5, 2), rng.uniform(-5, 5, 2)])
        if env.is_free(state[:2]) and MAZES[maze].hidden(state) == hidden:
            found.append(state)
    return found


@pytest.mark.parametrize("maze", MAZES)
def test_registered_mazes_pass_gymnasiums_checker(maze):
    env = gymnasium.make(MAZES[maze].gym_id, render_mode="rgb_array")
    check_env(env.unwrapped)


@pytest.mark.parametrize("maze", MAZES)
def test_a_seed_fixes_everything(maze):
    def run(seed: int) -> tuple[bytes, np.ndarray]:
        env = MazeEnv(maze)
        obs, info = env.reset(seed=seed)
        for action in np.random.default_rng(0).uniform(-1, 1, (5, 2)):
            obs, _, _, _, info = env.step(action)
        return obs.tobytes(), np.concatenate([info["state"], info["goal"]])

    first, again, other = run(3), run(3), run(4)
    assert first[0] == again[0]
    np.testing.assert_array_equal(first[1], again[1])
    assert first[0] != other[0]


def test_seen_from_the_top_the_dynamics_are_pointmazes_own():
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    theirs = gymnasium.make("PointMaze_UMaze-v3").unwrapped
    theirs.reset(seed=0)
    ours = MazeEnv("three_curtains", pixels=False, action_repeat=5)
    ours.reset(seed=0)
    start = np.array([-0.3, 1.2, 1.0, -2.0])
    ours.set_state(start)
    theirs.point_env.set_state(start[:2], start[2:])
    for action in np.random.default_rng(0).uniform(-1, 1, (60, 2)):
        _, _, _, _, info = ours.step(action)
        for _ in range(5):
            expected, *_ = theirs.step(action)
        np.testing.assert_allclose(info["state"], expected["observation"], atol=1e-9)


def test_states_fully_under_a_curtain_look_alike_to_the_last_bit():
    rng = np.random.default_rng(0)
    for maze in ("one_curtain", "three_curtains"):
        for render in ("fast", "exact"):
            env = MazeEnv(maze, render=render)
            env.reset(seed=0)
            pictures = set()
            for state in states_of(maze, 12, True, env, rng):
                obs, info = env.reset(options={"state": state})
                assert info["hidden"]
                pictures.add(obs.tobytes())
            assert len(pictures) == 1, (maze, render)


def test_states_that_no_curtain_hides_can_be_told_apart():
    rng = np.random.default_rng(0)
    env = MazeEnv("three_curtains")
    env.reset(seed=0)
    clear = [s for s in states_of("three_curtains", 60, False, env, rng) if s[0] > 0.7 and abs(s[1]) > 0.9]
    assert len(clear) > 5
    assert len({env.reset(options={"state": s})[0].tobytes() for s in clear}) == len(clear)
    assert not MAZES["no_curtain"].hidden(np.zeros((4, 4))).any()


def test_every_curtain_hides_a_whole_passage():
    """At some point of each covered corridor the mass is hidden wherever it is across the corridor."""
    maze = MAZES["three_curtains"]
    across = np.linspace(-0.4, 0.4, 9)
    for states in ([(-0.25, 1 + a) for a in across], [(-0.25, -1 + a) for a in across], [(1 + a, 0) for a in across]):
        assert maze.hidden(np.array(states)).all()
    share = maze.hidden(np.stack(states_of_grid(), 0)).mean()
    assert 0.2 < share < 0.5


def states_of_grid() -> list[np.ndarray]:
    env = MazeEnv("no_curtain", pixels=False)
    places = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 61)] * 2), -1).reshape(-1, 2)
    return [place for place in places if env.is_free(place)]


@pytest.mark.parametrize("maze", ["no_curtain", "three_curtains"])
def test_the_fast_picture_is_mujocos(maze):
    rng = np.random.default_rng(1)
    fast, exact = MazeEnv(maze), MazeEnv(maze, render="exact")
    fast.reset(seed=0), exact.reset(seed=0)
    for state in states_of(maze, 20, False, fast, rng):
        ours, theirs = (env.reset(options={"state": state})[0].astype(int) for env in (fast, exact))
        assert np.abs(ours - theirs).mean() < 0.05
        assert np.abs(ours - theirs).max() <= 24


def test_the_fast_first_person_picture_is_mujocos_but_for_its_highlights():
    rng = np.random.default_rng(1)
    fast, exact = MazeEnv("first_person"), MazeEnv("first_person", render="exact")
    fast.reset(seed=0), exact.reset(seed=0)
    for _ in range(20):
        state = np.array([*fast._free_place(), rng.uniform(-np.pi, np.pi), 0, 0, 0])
        ours, theirs = (env.reset(options={"state": state})[0].astype(int) for env in (fast, exact))
        assert np.abs(ours - theirs).mean() < 4
        assert (np.abs(ours - theirs) > 20).mean() < 0.02


def test_curtains_do_not_collide_and_goals_are_not_drawn():
    env = MazeEnv("three_curtains")
    env.reset(seed=0, options={"state": np.array([-1.2, 1.0, 3.0, 0.0])})
    for _ in range(30):
        _, _, _, _, info = env.step(np.array([0.3, 0.0]))
    assert info["state"][0] > 1.0
    before = env.reset(seed=1, options={"state": np.array([1.2, 1.2, 0, 0])})[0]
    env.goal = np.array([1.0, 1.0])
    assert (env.reset(seed=2, options={"state": np.array([1.2, 1.2, 0, 0])})[0] == before).all()


def test_first_person_velocities_follow_the_papers_update():
    env = MazeEnv("first_person", pixels=False, action_repeat=1)
    env.reset(seed=0)
    heading = 0.7
    env.set_state(np.array([1.0, 1.0, heading, 0.0, 0.0, 0.0]))
    _, _, _, _, info = env.step(np.array([1.0, 0.5]))
    _, _, turned, vx, vy, spin = info["state"]
    assert np.arctan2(vy, vx) == pytest.approx(heading, abs=1e-3)
    assert np.hypot(vx, vy) == pytest.approx(10.0 * 0.01, rel=0.01)
    assert spin == pytest.approx(0.5 * 4.0, rel=1e-6)
    assert turned - heading == pytest.approx(0.5 * 4.0 * 0.01, rel=1e-6)


def test_first_person_sees_where_it_looks():
    env = MazeEnv("first_person")
    env.reset(seed=0)
    place = [1.0, 1.0]
    near, far = (env.reset(options={"state": np.array([*place, a, 0, 0, 0])})[0] for a in (0.0, np.pi))
    wall = np.array([0.7, 0.5, 0.3])
    share = [((obs.transpose(1, 2, 0) @ wall) > 100).mean() for obs in (near, far)]
    assert share[0] > share[1] + 0.1, "the near wall fills more of the picture than the corridor"


def test_goals_move_when_they_are_reached():
    env = MazeEnv("no_curtain", pixels=False)
    env.reset(seed=0)
    env.set_state(np.array([*env.goal, 0.0, 0.0]))
    goal = env.goal
    _, reward, terminated, truncated, info = env.step(np.zeros(2))
    assert (reward, terminated, truncated) == (1.0, False, False)
    assert not np.allclose(goal, info["goal"])


def test_an_unknown_maze_is_named_with_the_choices():
    with pytest.raises(UserError, match="unknown maze 'spiral': choose one of no_curtain, one_curtain"):
        get_maze("spiral")
    assert "vd4rl_pomdp/MazeThreeCurtains-v0" in gymnasium.registry
    assert gymnasium.spec("vd4rl_pomdp/MazeNoCurtain-v0").max_episode_steps == vd4rl_pomdp.envs.MAZE_STEPS


def test_mazes_and_dm_control_end_quietly_in_one_process():
    code = """
import gymnasium, numpy as np, vd4rl_pomdp.envs
for name in ("WalkerWalk", "MazeThreeCurtains", "CheetahRun"):
    env = gymnasium.make(f"vd4rl_pomdp/{name}-v0")
    env.reset(seed=0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr, done.stderr
