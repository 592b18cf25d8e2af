import gymnasium
import numpy as np
import pytest

from tests.helpers_envs import Counter
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, DMCTask, GymnasiumTask
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.envs.gym import GymEnv
from vd4rl_pomdp.envs.gymnasium_task import area_means
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.rendering import mujoco


def play(task, decisions, **options):
    env = make_env(task, **options)
    return [env.reset(0), *(env.step(np.zeros(2, np.float32)) for _ in range(decisions))]


@pytest.mark.parametrize("pixels", ["render", "observation"])
@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 1), (20, 30, 3), (3, 20, 30), (1, 20, 30), (16, 16, 3)])
def test_images_of_any_layout_become_frames(pixels, shape):
    rows = play(GymnasiumTask(Counter, {"shape": shape}, pixels=pixels), 2, size=16)
    for t, row in enumerate(rows):
        assert (row.frame.dtype, row.frame.shape) == (np.uint8, (3, 16, 16))
        assert (row.frame == t).all()


def exact_means(picture: np.ndarray, size: int) -> np.ndarray:
    """Block means of the image after upsampling to a common multiple of both sizes; halves are rounded up."""
    tall, wide = (np.lcm(old, size) for old in picture.shape[:2])
    fine = picture.repeat(tall // picture.shape[0], 0).repeat(wide // picture.shape[1], 1)
    sums = fine.reshape(size, tall // size, size, wide // size, 3).sum((1, 3), dtype=np.int64)
    number = (tall // size) * (wide // size)
    return (2 * sums + number) // (2 * number)


NOT_WHOLE = [(120, 120), (480, 480), (100, 100), (85, 85), (168, 120), (90, 168), (60, 100), (64, 64)]


@pytest.mark.parametrize("shape", NOT_WHOLE, ids=str)
def test_area_means_match_exact_means(shape):
    picture = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    assert np.array_equal(area_means(picture, 84), exact_means(picture, 84))


class OneBuffer(Counter):
    """Renders every image into the same memory."""

    def picture(self):
        self.buffer = getattr(self, "buffer", np.empty(self.shape, np.uint8))
        self.buffer[:] = self.steps
        return self.buffer


@pytest.mark.parametrize("shape", [(3, 16, 16), (16, 16, 3), (16, 16)])
def test_frames_are_copied_from_reused_buffers(shape):
    for t, row in enumerate(play(GymnasiumTask(OneBuffer, {"shape": shape}, pixels="observation"), 2, size=16)):
        assert (row.frame == t).all()
        assert row.frame.flags.c_contiguous


def test_actions_are_repeated_and_rewards_summed():
    rows = play(GymnasiumTask(Counter, action_repeat=3), 2)
    assert [row.reward for row in rows] == [0, 1 + 2 + 3, 4 + 5 + 6]
    assert (rows[2].frame == 6).all()


@pytest.mark.parametrize(("truncates", "discount"), [(False, 0.0), (True, 1.0)])
def test_episode_end_within_action_repeat(truncates, discount):
    rows = play(GymnasiumTask(Counter, {"end": 5, "truncates": truncates}, action_repeat=3), 2)
    assert [row.step_type for row in rows] == [StepType.FIRST, StepType.MID, StepType.LAST]
    assert [row.discount for row in rows] == [1.0, 1.0, discount]
    assert rows[2].terminated != truncates
    assert rows[2].reward == 4 + 5


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-3.0, 5.0), (0.0, 0.5)])
def test_actions_are_scaled_and_reshaped(low, high):
    env = make_env(GymnasiumTask(Counter, {"low": low, "high": high}))
    env.reset(0)
    for action in ([-1, 1], [0, 2], [0.1, -0.7]):
        env.step(np.array(action, np.float32))
    np.testing.assert_array_equal(env.env.actions[0].ravel(), [low, high])
    np.testing.assert_allclose(env.env.actions[1].ravel(), [(low + high) / 2, high])
    assert env.env.actions[0].shape == (2, 1)
    if (low, high) == (-1.0, 1.0):
        np.testing.assert_array_equal(env.env.actions[2].ravel(), np.array([0.1, -0.7], np.float32))


def test_environment_is_made_by_id_and_arguments():
    gymnasium.register("vd4rl_pomdp_test/Counter-v0", entry_point=Counter, max_episode_steps=4)
    try:
        rows = play(GymnasiumTask("vd4rl_pomdp_test/Counter-v0", {"end": 9}), 4)
        assert (rows[4].last, rows[4].discount) == (True, 1.0), "the environment's time limit truncates"
    finally:
        gymnasium.registry.pop("vd4rl_pomdp_test/Counter-v0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"space": gymnasium.spaces.Discrete(3)}, r"has the actions Discrete\(3\)"),
        ({"space": gymnasium.spaces.Box(-3, 3, (2,), np.int64)}, r"has the actions Box\(-3, 3, \(2,\), int64\), but a"),
        ({"space": gymnasium.spaces.Box(-1, 1, (0,))}, r"has the actions Box\(.*needs a bounded Box"),
        ({"high": np.inf}, "Counter has actions from -1 to inf: only bounds within -1e[+]09 and 1e[+]09 can be"),
        ({"low": -1e10}, "Counter has actions from -1e[+]10 to 1: only bounds"),
        ({"shape": (20,)}, r"Counter returns uint8 of shape \(20,\) from its render\(\)"),
        ({"shape": (20, 30, 4)}, r"Counter returns uint8 of shape \(20, 30, 4\)"),
        ({"shape": (0, 30, 3)}, r"Counter returns uint8 of shape \(0, 30, 3\)"),
    ],
)
def test_unsupported_environments_are_rejected(arguments, message):
    with pytest.raises(UserError, match=message):
        play(GymnasiumTask(Counter, arguments), 0)


@pytest.mark.parametrize("place", ["reset", "step", "render"])
def test_late_missing_dependency_is_reported(place):
    def refuse(self, *arguments, **options):
        raise gymnasium.error.DependencyNotInstalled("pygame is not installed,\nrun `pip install pygame`")

    needy = type("Needy", (Counter,), {place: refuse})
    with pytest.raises(UserError, match=r"Needy cannot .* \(pygame is not installed, run `pip .* install what"):
        play(GymnasiumTask(needy), 1)


def test_termination_and_truncation_are_distinguished():
    with TASKS.isolated():
        TASKS.register("ending", GymnasiumTask(Counter, {"end": 2}))
        TASKS.register("cut", GymnasiumTask(Counter, {"end": 2, "truncates": True}))
        for name, ends in (("ending", (True, False)), ("cut", (False, True))):
            env = GymEnv(name, corruption="patch", patch_size=4, frame_size=16)
            obs, info = env.reset(seed=0)
            assert obs.shape == (9, 16, 16)
            assert info["physics"].shape == (0,)
            assert env.step(np.zeros(2, np.float32))[2:4] == (False, False)
            assert env.step(np.zeros(2, np.float32))[2:4] == ends


def test_terminating_dm_control_task_has_discount_0(monkeypatch):
    env = make_env(DMCTask("pendulum", "swingup"), size=None)
    env.reset(0)
    monkeypatch.setattr(env.simulator.task, "get_termination", lambda physics: 0.0)
    row = env.step(np.zeros(1))
    assert (row.last, row.discount, row.terminated) == (True, 0.0, True)


def test_environment_without_seed_is_rejected():
    seedless = type("Seedless", (Counter,), {"reset": lambda self: Counter.reset(self)})
    with pytest.raises(UserError, match=r"Seedless cannot be reset with a seed \(.* 'seed'\): give it Gymnasium's"):
        make_env(GymnasiumTask(seedless)).reset(0)
    failing = type("Failing", (Counter,), {"reset": lambda self, seed: len(seed)})
    with pytest.raises(TypeError, match="has no len"):  # the environment's own defects are not converted
        make_env(GymnasiumTask(failing)).reset(0)


@pytest.mark.parametrize(
    ("attributes", "rate"),
    [
        ({"metadata": {"render_fps": 20}}, 10),
        ({"metadata": {"render_fps": None}}, 15),
        ({"metadata": {"render_fps": "fast"}}, 15),
        ({"metadata": {"render_fps": np.int64(20)}}, 10),
        ({"metadata": {}}, 15),
        ({"metadata": {"render_fps": 25}, "control_timestep": lambda self: 0.025}, 20),  # as shimmy's
    ],
)
def test_frame_rate_prefers_time_step_over_metadata(attributes, rate):
    env = make_env(GymnasiumTask(type("Timed", (Counter,), attributes), action_repeat=2))
    assert env.rate == rate


def test_gymnasium_cheetah_renders_one_simulator_step_late():
    """As documented in docs/add_a_task.md."""
    env = make_env(GymnasiumTask("HalfCheetah-v5"), size=None)
    env.reset(0)
    model, data = env.env.unwrapped.model, env.env.unwrapped.data
    before = mujoco.MjData(model)
    before.qpos[:], before.qvel[:], before.ctrl[:] = data.qpos, data.qvel, 1
    env.step(np.ones(6, np.float32))
    mujoco.mj_step(model, before, env.env.unwrapped.frame_skip - 1)
    mujoco.mj_forward(model, before)
    drawn = data.xpos.copy()
    np.testing.assert_allclose(drawn, before.xpos, atol=1e-9)
    mujoco.mj_forward(model, data)
    assert np.abs(data.xpos - drawn).max() > 1e-3
