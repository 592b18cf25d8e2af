import pickle
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.types import row_key
from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys, make_corruption
from vd4rl_pomdp.envs import FINITE_IDS, FINITE_STEPS, GYM_IDS, MAZE_STEPS
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.envs.mazes import MAZES


def make(name, **arguments):
    return gymnasium.make(f"vd4rl_pomdp/{name}-v0", disable_env_checker=True, **arguments)


@pytest.mark.parametrize("name", ["WalkerWalk", "MazeNoCurtain"])
def test_invalid_actions_are_rejected(name):
    env = make(name)
    env.reset(seed=0)
    for action in (np.ones(1), np.ones(env.action_space.shape[0] + 1), np.full(env.action_space.shape, np.nan)):
        with pytest.raises(UserError, match=f"is not one of {env.action_space.shape[0]} finite numbers"):
            env.unwrapped.step(action)


@pytest.mark.parametrize("name", [name for name in GYM_IDS if "Walker" in name or name.count("-") == 1])
def test_ids_pass_the_gymnasium_checker(name):
    env = gymnasium.make(name, render_mode="rgb_array", disable_env_checker=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # Gymnasium's kind
        check_env(env.unwrapped)
    env.close()


def test_environment_pickles_as_a_new_one():
    """As pickled by a worker that is spawned: one that has begun arrives as a new one."""
    env = make("WalkerWalk", corruption="patch+zero_frames", patch_size=24, frame_size=64)
    env.reset(seed=3)
    sent = pickle.loads(pickle.dumps(env.unwrapped))
    with pytest.raises(UserError, match="call reset"):
        sent.step(np.zeros(6, np.float32))
    np.testing.assert_array_equal(sent.reset(seed=5)[0], env.reset(seed=5)[0])
    for action in (np.ones(6, np.float32), -np.ones(6, np.float32)):
        np.testing.assert_array_equal(sent.step(action)[0], env.step(action)[0])


def test_frame_stack_order_and_padding():
    env = make("WalkerWalk")
    obs, info = env.reset(seed=0)
    first = obs[:3].copy()
    assert (obs == np.tile(first, (3, 1, 1))).all()
    assert info["physics"].dtype == np.float64
    second = env.step(np.ones(6, np.float32))[0]
    third = env.step(-np.ones(6, np.float32))[0]
    np.testing.assert_array_equal(second[:6], obs[:6])
    assert not np.array_equal(second[6:], first)
    np.testing.assert_array_equal(third[:6], second[3:])
    np.testing.assert_array_equal(env.render(), third[6:].transpose(1, 2, 0))
    obs[:] = 0
    assert info["clean"].any(), "a copy"


def test_ids_have_their_time_limits():
    ours = {
        name: spec.max_episode_steps for name, spec in gymnasium.registry.items() if name.startswith("vd4rl_pomdp/")
    }
    mazes = dict.fromkeys((maze.gym_id for maze in MAZES.values()), MAZE_STEPS)
    assert ours == dict.fromkeys(GYM_IDS, 500) | mazes | dict.fromkeys(FINITE_IDS, FINITE_STEPS)


@pytest.mark.parametrize(
    "name", ["vd4rl_pomdp/WalkerWalk-v0", "vd4rl_pomdp/MazeFirstPerson-v0", "vd4rl_pomdp/ForwardJumpCounterexample-v0"]
)
def test_time_limit_truncates_and_needs_reset(name):
    made = gymnasium.make(name, max_episode_steps=2)
    for env in (made, gymnasium.make(made.spec)):
        for seed in (0, None):
            env.reset(seed=seed)
            action = env.action_space.sample()
            assert [env.step(action)[2:4] for _ in range(2)] == [(False, False), (False, True)]
            with pytest.raises(ResetNeeded, match="reset"):
                env.step(action)


def test_patch_and_zero_frames_ids_corrupt_observations():
    obs, info = make("WalkerWalk-Patch16").reset(seed=0)
    assert ((obs != info["clean"]).reshape(3, 3, -1).any(1).sum(1) == 256).all()
    obs, info = make("WalkerWalk-ZeroFrames").reset(seed=0)
    shown, clean = obs.reshape(3, 3, 84, 84), info["clean"].reshape(3, 3, 84, 84)
    assert sorted(frame.any() for frame in shown) == [False, False, True]
    assert all((frame == plain).all() for frame, plain in zip(shown, clean, strict=True) if frame.any())


def test_seed_fixes_states_and_masks_of_a_series_of_episodes():
    env = make("WalkerWalk-Patch16")
    series = [[env.reset(seed=7), env.reset()] for _ in range(2)]
    for (obs, info), (same_obs, same_info) in zip(*series, strict=True):
        np.testing.assert_array_equal(obs, same_obs)
        np.testing.assert_array_equal(info["physics"], same_info["physics"])
    (one, one_info), (two, two_info) = series[0]
    assert not np.array_equal(one_info["physics"], two_info["physics"])
    assert not np.array_equal(one != one_info["clean"], two != two_info["clean"])


@pytest.mark.parametrize("name", ["patch", "zero_frames", "patch+zero_frames"])
def test_environment_and_batch_corrupt_equally(name):
    env = CorruptedEnv(TASKS["walker_walk"], CorruptionConfig.of(name), length=4)
    steps = [env.reset(1, corruption_seed=5, episode=2)] + [env.step(np.zeros(6, np.float32)) for _ in range(3)]
    keys = derive_keys(5, row_key(torch.tensor([2]), torch.arange(4)))
    batch = make_corruption(name)(torch.stack([step.clean for step in steps]), keys)
    torch.testing.assert_close(torch.stack([step.obs for step in steps]), batch, rtol=0, atol=0)
    assert not torch.equal(batch[0], steps[0].clean)


def test_corruption_options_are_arguments():
    env = make("WalkerWalk", corruption="patch", patch_size=24, patch_count=1, patch_fill=255, patch_shared=True)
    obs, info = env.reset(seed=0)
    changed = (obs != info["clean"]).reshape(3, 3, -1).any(1)
    assert (changed.sum(1) == 24 * 24).all()
    assert (changed == changed[0]).all()
    assert (obs.reshape(3, 3, -1).transpose(0, 2, 1)[changed] == 255).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render": "x"}, "'x'"),
        ({"patch_sise": 8}, "--patch-sise is not read by the corruption none"),
        ({"corruption": "patch", "patch_size": 85}, "patch size 85 exceeds the image"),
        ({"corruption": "patch", "patch_size": 17, "frame_size": 16}, "patch size 17 exceeds the image"),
        ({"frame_size": 8}, "--frame-size is 8"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(UserError, match=message):
        make("WalkerWalk", **arguments)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("WalkerWalk", {}),
        ("WalkerWalk", {"render": "exact"}),
        ("MazeNoCurtain", {}),
        ("MazeNoCurtain", {"render": "exact"}),
        ("ForwardJumpCounterexample", {}),
    ],
)
def test_closed_environments_can_be_reset(name, arguments):
    closed, fresh = (make(name, **arguments).unwrapped for _ in range(2))
    closed.reset(seed=0)
    closed.close()
    closed.close()
    np.testing.assert_array_equal(closed.reset(seed=3)[0], fresh.reset(seed=3)[0])
    action = fresh.action_space.sample()
    np.testing.assert_array_equal(closed.step(action)[0], fresh.step(action)[0])
