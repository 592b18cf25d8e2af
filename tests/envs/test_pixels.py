"""Behaviour shared by all kinds of tasks: action scaling and steps outside an episode."""

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import DMCTask, GymnasiumTask
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.pixels import between, check_bounds


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble])
def test_scaled_actions_reach_and_respect_bounds(dtype):
    rng = np.random.default_rng(0)
    low, high = np.sort(np.round(rng.uniform(-5, 5, (2, 3000)), 2), 0).astype(dtype)
    ends = [between(end * np.ones(3000, np.float32), low, high) for end in (-1, 1)]
    for found, bound in zip(ends, (low, high), strict=True):
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, bound)
    for _ in range(20):
        inner = between(rng.uniform(-1, 1, 3000).astype(np.float32), low, high)
        almost = between(np.full(3000, np.nextafter(np.float32(1), np.float32(0))), low, high)
        assert ((low <= inner) & (inner <= high) & (inner <= almost + 1e-2) & (almost <= high)).all()
    np.testing.assert_array_equal(between(np.full(3000, 7.0), low, high), high)
    middle = (low.astype(float) + high.astype(float)) / 2
    np.testing.assert_allclose(between(np.zeros(3000), low, high), middle, atol=5e-3)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble])
def test_infinite_action_bounds_are_rejected(dtype):
    one = np.ones(2, dtype)
    check_bounds("it", -one, one)
    for far in (np.inf, np.nan, *([1e10] if dtype != np.float16 else [])):
        with pytest.raises(UserError, match=r"it has actions from -1 to .*: only bounds within"):
            check_bounds("it", -one, np.array([1, far], dtype))


@pytest.mark.parametrize("task", [DMCTask("pendulum", "swingup"), GymnasiumTask("HalfCheetah-v5")])
def test_step_outside_an_episode_is_rejected(task):
    env = make_env(task, size=None, length=1)
    action = np.zeros(env.action_dim, np.float32)
    for _ in range(2):
        with pytest.raises(UserError, match=r"no episode has begun, or it is over: call reset\(\) before the next"):
            env.step(action)
        env.reset(0)
        env.step(action)
