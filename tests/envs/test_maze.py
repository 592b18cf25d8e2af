import copy
import pickle
import tempfile

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.maze import MazeEnv, build_simulator, replay_states
from vd4rl_pomdp.envs.maze_renderers import panorama, sky_texture
from vd4rl_pomdp.envs.mazes import HARD, MAZES, PAPER_MAZES

CURTAINED = [name for name, spec in MAZES.items() if spec.curtains]
FIRST_PERSON = [name for name, spec in MAZES.items() if spec.first_person]


def states_of(maze: str, count: int, hidden: bool, env: MazeEnv, rng: np.random.Generator) -> list[np.ndarray]:
    """Free states with random velocities, either fully under a curtain or not."""
    found: list[np.ndarray] = []
    while len(found) < count:
        state = np.concatenate([rng.uniform(-1.5, 1.5, 2), rng.uniform(-5, 5, 2)])
        if env.is_free(state[:2]) and MAZES[maze].hidden(state) == hidden:
            found.append(state)
    return found


@pytest.mark.parametrize("maze", PAPER_MAZES)
def test_mazes_pass_the_gymnasium_checker(maze):
    env = gymnasium.make(MAZES[maze].gym_id, render_mode="rgb_array")
    check_env(env.unwrapped)


@pytest.mark.parametrize("maze", PAPER_MAZES)
def test_mazes_are_seeded(maze):
    def run(seed: int) -> tuple[bytes, np.ndarray]:
        env = MazeEnv(maze)
        obs, info = env.reset(seed=seed)
        for action in np.random.default_rng(0).uniform(-1, 1, (5, 2)):
            obs, _, _, _, info = env.step(action)
        return obs.tobytes(), np.concatenate([info["state"], info["goal"]])

    first, again, other = run(3), run(3), run(4)
    assert first[0] == again[0]
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[1], other[1])
    assert maze.endswith("curtains") or first[0] != other[0], "both may be hidden"


@pytest.mark.parametrize("maze", ["three_curtains", "hard_three_curtains"])
def test_top_view_dynamics_match_pointmaze(maze, tmp_path, monkeypatch):
    """The generator clips velocities once per decision, PointMaze and the hard mazes before every step."""
    import gymnasium_robotics

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # PointMaze leaves its model there
    gymnasium.register_envs(gymnasium_robotics)
    theirs = gymnasium.make("PointMaze_UMaze-v3").unwrapped
    theirs.reset(seed=0)
    ours = MazeEnv(maze, pixels=False, action_repeat=5)
    ours.reset(seed=0)
    start = np.array([-1.3, 1.0, 4.9, 0.0])  # the first action exceeds the limit of 5
    ours.set_state(start)
    theirs.point_env.set_state(start[:2], start[2:])
    for action in [np.array([1.0, 0.0]), *np.random.default_rng(0).uniform(-1, 1, (60, 2))]:
        _, _, _, _, info = ours.step(action)
        if MAZES[maze].style is HARD:
            for _ in range(5):
                theirs.step(action)
        else:
            theirs.point_env._clip_velocity()
            theirs.point_env.do_simulation(action, 5)
        expected = np.concatenate([theirs.point_env.data.qpos, theirs.point_env.data.qvel])
        np.testing.assert_allclose(info["state"], expected, atol=1e-9)


@pytest.mark.parametrize("maze", CURTAINED)
@pytest.mark.parametrize("render", ["fast", "exact"])
def test_hidden_states_have_identical_observations(maze, render):
    rng = np.random.default_rng(0)
    env = MazeEnv(maze, render=render)
    env.reset(seed=0)
    pictures = set()
    for state in states_of(maze, 40 if render == "fast" else 12, True, env, rng):
        obs, info = env.reset(options={"state": state})
        assert info["hidden"]
        pictures.add(obs.tobytes())
    assert len(pictures) == 1


@pytest.mark.parametrize("state", [[0.0, 1.0], [np.nan, 1.0, 0.0, 0.0]])
def test_invalid_states_are_rejected(state):
    with pytest.raises(UserError, match="no_curtain: a state is 4 finite numbers"):
        MazeEnv("no_curtain").reset(options={"state": state})


def test_observations_are_the_callers_own():
    env = MazeEnv("no_curtain")
    obs, _ = env.reset(seed=0)
    obs[:] = 0
    assert env.render().any()


def test_visible_states_have_distinct_observations():
    rng = np.random.default_rng(0)
    env = MazeEnv("three_curtains")
    env.reset(seed=0)
    clear = [s for s in states_of("three_curtains", 60, False, env, rng) if s[0] > 0.5 and abs(s[1]) > 0.9]
    assert len(clear) > 5
    assert len({env.reset(options={"state": s})[0].tobytes() for s in clear}) == len(clear)
    assert not MAZES["no_curtain"].hidden(np.zeros((4, 4))).any()


def states_of_grid() -> np.ndarray:
    env = MazeEnv("no_curtain", pixels=False)
    places = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 61)] * 2), -1).reshape(-1, 2)
    return np.stack([place for place in places if env.is_free(place)])


def test_curtains_cover_passages_of_hard_mazes_and_cells_of_the_papers():
    """A state counts as hidden if no part of the ball is visible."""
    hard, three, one = (MAZES[name] for name in ("hard_three_curtains", "three_curtains", "one_curtain"))
    across = np.linspace(-0.4, 0.4, 9)
    for states in ([(-0.25, 1 + a) for a in across], [(-0.25, -1 + a) for a in across], [(1 + a, 0) for a in across]):
        assert hard.hidden(np.array(states)).all()
    ends, bend = np.array([(-1.0, 1.0), (-1.0, -1.0)]), np.array([1.0, 0.0])
    assert three.hidden(ends).all()
    assert three.hidden(bend)
    assert one.hidden(bend)
    assert not one.hidden(ends).any()
    assert not three.hidden(np.array([(-0.5, 1.0), (0.0, -1.0), (1.0, 0.5), (1.0, 1.0)])).any()
    grid = states_of_grid()
    assert 0.2 < hard.hidden(grid).mean() < 0.5
    assert 0.2 < three.hidden(grid).mean() < 0.3


TOP = ["no_curtain", "three_curtains", "hard_no_curtain", "hard_three_curtains"]


@pytest.mark.parametrize("maze", [*TOP, *FIRST_PERSON])
def test_fast_rendering_is_close_to_mujoco(maze):
    rng = np.random.default_rng(1)
    fast, exact = MazeEnv(maze), MazeEnv(maze, render="exact")
    fast.reset(seed=0), exact.reset(seed=0)
    turned = [np.array([*fast._free_place(), rng.uniform(-np.pi, np.pi), 0, 0, 0]) for _ in range(20)]
    for state in states_of(maze, 20, False, fast, rng) if maze in TOP else turned:
        ours, theirs = (env.reset(options={"state": state})[0].astype(int) for env in (fast, exact))
        difference = np.abs(ours - theirs)
        assert difference.mean() < (0.1 if maze in TOP else 6)
        assert difference.max() <= 32 if maze in TOP else (difference > 20).mean() < 0.02


@pytest.mark.parametrize("maze", ["three_curtains", "first_person"])
def test_observations_match_their_states(maze):
    """MuJoCo does not update body positions after its last step."""
    rng = np.random.default_rng(0)
    fast, exact, again = MazeEnv(maze), MazeEnv(maze, render="exact"), MazeEnv(maze, render="exact")
    for env in (fast, exact, again):
        env.reset(seed=0)
    for action in rng.uniform(-1, 1, (6, 2)):
        shown, _, _, _, info = exact.step(action)
        np.testing.assert_array_equal(shown, again.reset(options={"state": info["state"]})[0])
        np.testing.assert_array_equal(fast.step(action)[-1]["state"], info["state"])


def test_curtains_do_not_collide_and_goals_are_not_drawn():
    env = MazeEnv("three_curtains")
    env.reset(seed=0, options={"state": np.array([-1.2, 1.0, 3.0, 0.0])})
    for _ in range(30):
        _, _, _, _, info = env.step(np.array([0.3, 0.0]))
    assert info["state"][0] > 1.0
    before = env.reset(seed=1, options={"state": np.array([1.2, 1.2, 0, 0])})[0]
    env.goal = np.array([1.0, 1.0])
    assert (env.reset(seed=2, options={"state": np.array([1.2, 1.2, 0, 0])})[0] == before).all()


def test_first_person_dynamics_match_the_generator():
    env = MazeEnv("first_person", pixels=False)
    env.reset(seed=0, options={"state": np.array([-1.0, 1.0, 0.7, 0.0, 0.0, 0.0])})
    _, _, _, _, info = env.step(np.array([1.0, 1.0]))
    _, _, heading, vx, vy, spin = info["state"]
    assert heading - 0.7 == pytest.approx(0.27, abs=0.005)
    assert spin < 0.02 * 40, "remaining turning rate"
    assert np.hypot(vx, vy) == pytest.approx(0.1, rel=0.02), "one push per decision"
    assert np.arctan2(vy, vx) == pytest.approx(0.7, abs=1e-6)
    _, _, _, _, after = env.step(np.zeros(2))
    assert after["state"][5] == pytest.approx(spin * 0.403**5, rel=0.02), "a zero action sets nothing"
    _, _, _, _, info = env.step(np.array([1.0, 0.0]))
    assert info["state"][5] == 0


def test_cameras_and_sky_match_the_generator():
    """Top view: 30 degrees, 7 above the centre; first person: 60 degrees, in the ball, under a fading blue sky."""
    for maze, fovy, height in (("three_curtains", 30, 7), ("first_person", 60, 0)):
        model = build_simulator(MAZES[maze])[0].model
        assert (model.cam_fovy[0], model.cam_pos[0, 2]) == (fovy, height), maze
    sky = panorama(sky_texture("stars"), np.radians([89, 1, -89])).astype(float)
    above, ahead, below = np.median(sky, 0)  # between the stars
    np.testing.assert_allclose(above, 255 * np.array([0.4, 0.6, 0.8]), atol=3)
    np.testing.assert_allclose(ahead, above / 2, atol=3)
    np.testing.assert_allclose(below, 0, atol=3)
    assert 0.02 < (sky[:, 1] > ahead + 30).all(1).mean() < 0.06, "white stars"


def test_compass_sky_distinguishes_headings():
    """A corner looks the same from both sides, except for lighting and the sky."""
    for maze, least in (("compass_first_person", 40), ("hard_first_person", 0)):
        env = MazeEnv(maze)
        env.reset(seed=0)
        tops = [
            env.reset(options={"state": np.array([1.0, 1.0, a, 0, 0, 0])})[0][:, 0].astype(int).mean((1,))
            for a in (-np.pi * 0.75, np.pi * 0.75)
        ]
        assert np.abs(tops[0] - tops[1]).max() >= least, maze


def test_hard_first_person_dynamics_match_the_paper():
    env, heading = MazeEnv("hard_first_person", pixels=False, action_repeat=1), 0.7
    env.reset(seed=0, options={"state": np.array([1.0, 1.0, heading, 0.0, 0.0, 0.0])})
    _, _, turned, vx, vy, spin = env.step(np.array([1.0, 0.5]))[-1]["state"]
    assert np.arctan2(vy, vx) == pytest.approx(heading, abs=1e-3)
    assert np.hypot(vx, vy) == pytest.approx(10.0 * 0.01, rel=0.01)
    assert spin == pytest.approx(0.5 * 4.0, rel=1e-6)
    assert turned - heading == pytest.approx(0.5 * 4.0 * 0.01, rel=1e-6)


def test_goals_are_cell_points_and_move_when_reached():
    env = MazeEnv("no_curtain", pixels=False)
    goals = set()
    for seed in range(60):
        env.reset(seed=seed)
        goal = env.goal
        assert env.is_free(goal)
        goals.add(tuple(np.round(goal, 6)))
    env.set_state(np.array([*goal, 0.0, 0.0]))
    _, reward, terminated, truncated, info = env.step(np.zeros(2))
    assert (reward, terminated, truncated) == (1.0, False, False)
    assert not np.allclose(goal, info["goal"])
    assert goals == {(x + 0.2, y - 0.2) for x, y in [(-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]}


def test_goals_need_a_halt_except_in_hard_mazes():
    for maze, reward in (("no_curtain", 0.0), ("hard_no_curtain", 1.0)):
        env = MazeEnv(maze, pixels=False)
        env.reset(seed=0, options={"state": np.array([-0.3, 1.0, 5.0, 0.0])})
        env.goal = np.array([-0.05, 1.0])
        assert env.step(np.zeros(2))[1] == reward


def test_unreached_goals_expire():
    for maze, decisions in (("first_person", 150), ("no_curtain", 150), ("hard_no_curtain", None)):
        env = MazeEnv(maze, pixels=False)
        env.reset(seed=1)
        env.set_state(np.array([-1.3, -1.3, *env.state[2:]]))
        env.goal = first = np.array([1.2, 0.8])
        kept = 0
        while np.array_equal(env.goal, first) and kept < 151:
            env.step(np.zeros(2))
            kept += 1
        assert kept == (decisions or 151)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"render": "Exact"}, "unknown rendering 'Exact'"), ({"action_repeat": 0}, "--action-repeat is 0")],
)
def test_invalid_maze_arguments_are_rejected(arguments, message):
    with pytest.raises(UserError, match=message):
        MazeEnv("no_curtain", **arguments)


def test_first_person_starts_face_all_directions():
    env = MazeEnv("first_person", pixels=False)
    headings = np.array([env.reset(seed=seed)[1]["state"][2] for seed in range(60)])
    assert (headings.min(), headings.max()) == (pytest.approx(-np.pi, abs=0.5), pytest.approx(np.pi, abs=0.5))


def test_replay_repeats_actions_as_the_environment():
    env, actions = MazeEnv("no_curtain", 2, pixels=False), np.random.default_rng(0).uniform(-1, 1, (4, 2))
    start = env.reset(seed=0)[1]["state"]
    states = [env.step(action)[-1]["state"] for action in actions]
    np.testing.assert_allclose(replay_states("no_curtain", start, actions, 2), states)


@pytest.mark.parametrize("kind", ["fast", "exact"])
def test_requested_renderer_draws(kind, monkeypatch):
    made = []
    monkeypatch.setattr("vd4rl_pomdp.envs.maze.make_renderer", lambda *given: made.append(given[2]) or (lambda _: None))
    MazeEnv("no_curtain", render=kind).draw()
    assert made == [kind]


@pytest.mark.parametrize("render", ["fast", "exact"])
def test_mazes_can_be_copied_after_rendering(render):
    env = MazeEnv("one_curtain", render=render)
    env.reset(seed=0)
    copies = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    observation = env.step(np.ones(2))[0]
    for copied in copies:
        np.testing.assert_array_equal(copied.step(np.ones(2))[0], observation)
