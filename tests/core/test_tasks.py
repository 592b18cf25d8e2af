"""User-defined tasks: layouts derived from their models, replay, and invalid tasks."""

import re
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from tests.helpers_envs import Counter
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, DMCTask, GymnasiumTask, Layout
from vd4rl_pomdp.data.check import check_dataset
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.envs.dmc import replay_rewards, replays, start_from
from vd4rl_pomdp.envs.make import layout_of, make_env
from vd4rl_pomdp.envs.rendering import mujoco, suite


def test_task_registry_loads_no_simulator():
    code = "import sys, vd4rl_pomdp.core.tasks; print({'mujoco', 'gymnasium', 'torch'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize(
    ("domain", "task", "layout"),
    [
        ("cartpole", "swingup", Layout(1, 5, 2, turning=(1,))),  # fixed camera: the cart's position is visible
        ("hopper", "hop", Layout(4, 15, 7, travel=(0,), turning=(2,))),
        ("quadruped", "run", Layout(12, 78, 23, travel=(0, 1), quaternions=(3,))),
        ("reacher", "easy", Layout(2, 6, 2, turning=(0,))),
        ("ball_in_cup", "catch", Layout(2, 8, 4)),
    ],
)
def test_layouts_are_derived_from_models(domain, task, layout):
    found = layout_of(DMCTask(domain, task))
    assert found == layout
    physics = suite.load(domain, task).physics.get_state()
    width = len(physics) - len(layout.travel) + len(layout.turning) + 2 * len(layout.quaternions)
    assert found.visible_state(physics[None]).shape == (1, width)


def test_layout_keeps_ball_position_relative_to_camera():
    task = DMCTask("quadruped", "fetch")
    layout, physics = layout_of(task), suite.load(task.domain, task.task).physics.get_state()[None]
    assert (layout.travel, layout.beside) == ((0, 1), (23,))
    both, ball = physics.copy(), physics.copy()
    for place in (0, 23):
        both[:, place : place + 2] += (3, -2)
    ball[:, 23:25] += (3, -2)
    np.testing.assert_allclose(layout.visible_state(both), layout.visible_state(physics), atol=1e-5)
    moved = layout.visible_state(ball) - layout.visible_state(physics)
    assert sorted(moved[np.abs(moved) > 1e-5].round(4).tolist()) == [-2, 3]


def test_camera_on_a_hand_keeps_absolute_positions():
    layout = layout_of(DMCTask("stacker", "stack_2", camera=1))
    assert (layout.travel, layout.beside) == ((), ())


def test_actions_are_scaled_to_the_tasks_bounds():
    env = make_env(DMCTask("quadruped", "walk"), size=None)
    spec = env.simulator.action_spec()
    assert (spec.maximum != 1).any()
    for end, bound in ((-1.0, spec.minimum), (1.0, spec.maximum)):
        env.reset(0)
        env.step(np.full(env.action_dim, end, np.float32))
        np.testing.assert_allclose(env.physics.control(), bound)


def _alike(layout: Layout, physics: np.ndarray) -> np.ndarray:
    """Another simulator state with the same appearance."""
    other = physics.copy()
    other[list(layout.turning)] += [2 * np.pi * (-1) ** i for i in range(len(layout.turning))]
    for first in layout.quaternions:
        other[first : first + 4] *= -1
    return other


@pytest.mark.parametrize("name", [*TASKS, "quadruped walk", "acrobot swingup"])
def test_visible_states_are_equal_iff_frames_are(name):
    task = TASKS[name] if name in TASKS else DMCTask(*name.split())
    env, rng = make_env(task, size=48), np.random.default_rng(0)
    env.reset(1)
    for _ in range(30):
        step = env.step(rng.uniform(-1, 1, env.action_dim).astype(np.float32))
    other = _alike(env.layout, step.physics)
    assert name == "point_mass_cue" or np.abs(other - step.physics).max() > 0.1
    start_from(env.simulator, other)
    drawn = env._time_step(0.0, 1.0, step.step_type)
    np.testing.assert_array_equal(drawn.frame, step.frame)
    np.testing.assert_allclose(env.layout.visible_state(other), env.layout.visible_state(step.physics), atol=1e-6)
    turned = step.physics.copy()
    column = (*env.layout.turning, *(first + 1 for first in env.layout.quaternions), 0)[0]
    turned[column] += 0.2
    assert np.abs(env.layout.visible_state(turned) - env.layout.visible_state(step.physics)).max() > 0.01


def test_quaternion_pose_is_two_columns_of_its_rotation_matrix():
    quaternion, matrix = np.random.default_rng(0).normal(size=4), np.zeros(9)
    quaternion /= np.linalg.norm(quaternion)
    mujoco.mju_quat2Mat(matrix, quaternion)
    pose = Layout(1, positions=4, quaternions=(0,)).pose(quaternion)
    np.testing.assert_allclose(pose, matrix.reshape(3, 3)[:, :2].T.ravel(), atol=1e-12)


@pytest.mark.parametrize("task", ["cartpole swingup", "acrobot swingup", "dog walk", "quadruped fetch"])
def test_dm_control_rewards_replay(task):
    env, rng = make_env(DMCTask(*task.split()), size=None), np.random.default_rng(0)
    first = env.reset(3)
    actions = rng.uniform(-1, 1, (8, env.action_dim)).astype(np.float32)
    rewards = [env.step(action).reward for action in actions]
    with TASKS.isolated():
        TASKS.register("mine", env.task)
        assert replays(env.task)
        np.testing.assert_array_equal(replay_rewards("mine", first.physics, actions), rewards)


@pytest.mark.parametrize("task", ["reacher easy", "finger turn_hard", "swimmer swimmer6"])
def test_tasks_with_random_models_are_reported_as_not_replayable(task, tmp_path):
    with TASKS.isolated():
        TASKS.register("mine", DMCTask(*task.split()))
        collect(CollectConfig("mine", "random", tmp_path / "set", episodes=1, workers=1, frame_size=16), 2)
        report = check_dataset(tmp_path / "set", tmp_path / "cache")
    assert report["replay_max_error"] is None
    assert report["replay"] == "impossible: mine draws more than the simulator state for each episode"


def test_unknown_dm_control_task_lists_the_choices():
    with pytest.raises(UserError, match=r"dm_control has no task 'cartpole', 'swing': choose one of .*swingup"):
        layout_of(DMCTask("cartpole", "swing"))
    with pytest.raises(UserError, match=r"choose one of acrobot, .*walker"):
        layout_of(DMCTask("carpole", "swingup"))


BOTH, GYMNASIUM, DMC = (DMCTask, GymnasiumTask), (GymnasiumTask,), (DMCTask,)


@pytest.mark.parametrize(
    ("kinds", "settings", "message"),
    [
        (BOTH, {"decisions": 0}, "its decisions is 0: it must be an integer from 1"),
        (BOTH, {"decisions": 2**20}, "its decisions is 1048576: it must be an integer from 1 to 1048575"),
        (BOTH, {"decisions": 20.5}, "its decisions is 20.5: it must be an integer from 1"),
        (BOTH, {"action_repeat": 0}, "its action_repeat is 0: it must be an integer from 1"),
        (BOTH, {"score_divisor": 0.0}, "its score_divisor is 0.0: it must be a positive number"),
        (BOTH, {"score_divisor": -10.0}, "its score_divisor is -10.0: it must be a positive number"),
        (BOTH, {"score_divisor": np.nan}, "its score_divisor is nan: it must be a positive number"),
        (BOTH, {"score_divisor": "10"}, "its score_divisor is '10': it must be a positive number"),
        (BOTH, {"action_noise": -1.0}, "its action_noise is -1.0: it must be 0 or a positive number"),
        (BOTH, {"action_noise": "0.3"}, "its action_noise is '0.3'"),
        (GYMNASIUM, {"pixels": "Render"}, "unknown pixels 'Render'"),
        (DMC, {"camera": "side"}, "its camera is 'side': it must be the camera's number"),
    ],
)
def test_invalid_task_settings_are_rejected(kinds, settings, message):
    for kind in kinds:
        task = kind(*{DMCTask: ("cartpole", "swingup"), GymnasiumTask: ("CartPole-v1",)}[kind], **settings)
        with TASKS.isolated(), pytest.raises(UserError, match=f"task 'mine': {message}"):
            TASKS.register("mine", task)


@pytest.mark.parametrize("camera", [-1, 9])
def test_missing_camera_is_rejected(camera):
    message = f"dm_control's walker walk has no camera {camera}: register the task with one of 0 to 1"
    for layout in (None, TASKS["walker_walk"].layout):
        with pytest.raises(UserError, match=message):
            make_env(DMCTask("walker", "walk", camera, layout=layout))


def test_too_short_episodes_are_rejected():
    with pytest.raises(UserError, match="an episode of 0 decisions is too short"):
        make_env(DMCTask("walker", "walk", decisions=0))


@pytest.mark.parametrize("paid", [np.nan, np.inf, -np.inf, None, "much", np.ones(2)])
def test_non_numeric_reward_is_rejected(paid):
    env = make_env(GymnasiumTask(Counter, {"pays": [1.0, paid]}))
    env.reset(0)
    assert env.step(np.zeros(2, np.float32)).reward == 1
    with pytest.raises(
        UserError, match=rf"environment Counter returns the reward {re.escape(str(paid))}, expected a number"
    ):
        env.step(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    ("method", "given", "message"),
    [
        ("step", (np.zeros(1), 0.0, False, {}), "returns 4 values from step, expected 5 as in Gymnasium: wrap it"),
        ("reset", np.zeros(1), "returns a ndarray from reset, expected 2 as in Gymnasium: wrap it"),
    ],
)
def test_environment_of_another_interface_is_rejected(monkeypatch, method, given, message):
    monkeypatch.setattr(Counter, method, lambda self, *words, **more: given)
    env = make_env(GymnasiumTask(Counter))
    if method == "step":
        env.reset(0)
    with pytest.raises(UserError, match=message):
        env.step(np.zeros(2, np.float32)) if method == "step" else env.reset(0)


def test_missing_environment_is_rejected():
    for environment, arguments, reason in (
        ("NoSuchThing-v0", {}, "NoSuchThing"),
        ("no_such_module:Thing-v0", {}, "no_such_module"),
        (gymnasium.Env, {"colour": "red"}, "takes no arguments"),
    ):
        with pytest.raises(UserError, match=f"cannot be made .*{reason}"):
            make_env(GymnasiumTask(environment, arguments))


def test_tasks_compare_by_arguments():
    one, other = (GymnasiumTask("CartPole-v1", {"sutton_barto_reward": value}) for value in (True, False))
    assert one != other
    assert len({one, other}) == 2
    assert np.all([hash(one), hash(other)])
