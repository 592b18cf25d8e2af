import subprocess
import sys

import numpy as np
import pytest

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.dmc import DMCEnv, observed_states


def roll(env, seed, count, action_seed=0):
    rng = np.random.default_rng(action_seed)
    rows, actions = [env.reset(seed)], []
    for _ in range(count):
        actions.append(rng.uniform(-1, 1, env.action_dim).astype(np.float32))
        rows.append(env.step(actions[-1]))
    return rows, np.stack(actions)


@pytest.fixture(scope="module", params=TASKS)
def unrendered(request):
    return DMCEnv(TASKS[request.param], size=None)


def test_observed_states_are_recovered_from_physics(unrendered):
    rows, _ = roll(unrendered, 3, 20)
    found = observed_states(unrendered.task, np.stack([row.physics for row in rows]))
    np.testing.assert_allclose(found, np.stack([row.state for row in rows]), atol=1e-5)


def test_dmc_action_repeat_sums_rewards(unrendered):
    start = unrendered.reset(0).physics
    action = np.full(unrendered.action_dim, 0.5, np.float32)
    row = unrendered.step(action)
    by_hand = DMCEnv(unrendered.task, size=None)
    by_hand.reset(0)
    steps = [by_hand.simulator.step(action) for _ in range(2)]
    assert row.reward == steps[0].reward + steps[1].reward
    np.testing.assert_array_equal(row.physics, by_hand.physics.get_state())
    assert not np.array_equal(row.physics, start)


def test_rendering_is_equal_across_processes():
    code = (
        "import sys; from vd4rl_pomdp.envs.make import make_env; from vd4rl_pomdp.core.tasks import TASKS;"
        "env = make_env(TASKS['walker_walk']);"
        "env.reset(9); env.reset(1); sys.stdout.buffer.write(env.step([0.3] * 6).frame.tobytes())"
    )
    theirs = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    env = DMCEnv(TASKS["walker_walk"])
    env.reset(1)
    frame = env.step(np.full(6, 0.3)).frame
    assert (frame.shape, frame.dtype) == ((3, 84, 84), np.uint8)
    assert frame.tobytes() == theirs
