import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import vd4rl_pomdp.envs
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.studies.theory.study import enumerated, inverse_examples
from vd4rl_pomdp.studies.theory.world import BLANK, counterexample

K2 = {((1, -1), (0, -1)), ((-1, 1), (0, 1)), ((-1, -1), (2, -1)), ((1, 1), (2, 1))}
K4 = """
---- -++- +-+- ++-- 0 -1
--++ -+-+ +--+ ++++ 0 1
--+- -+-- +--- +++- 2 -1
---+ -+++ +-++ ++-+ 2 1
"""
"""The appendix's lists of examples, which are equal for (0, -1) and (0, 1)."""


def appendix_k4():
    for line in K4.strip().splitlines():
        *plans, x, b = line.split()
        for plan in plans:
            yield tuple(1 if sign == "+" else -1 for sign in plan), (int(x), int(b))


@pytest.mark.parametrize(("k", "listed"), [(2, K2), (4, set(appendix_k4()))])
def test_inverse_examples_match_the_appendix(k, listed):
    assert len(listed) == 2**k
    examples = inverse_examples(counterexample(), k)
    for start in ((0, -1), (0, 1)):
        assert {(actions, end) for s, actions, end in examples if s == start} == listed


def test_enumeration_matches_the_papers_counts():
    found = enumerated(counterexample())
    assert found["examples"] == 16368
    assert set(range(4, 11)) <= set(found["uniform_k"])
    assert found["uniform_k"] == list(range(3, 11)), "k = 3 is also uniform"
    assert found["informative_k"] == [1, 2]
    assert (found["diameter"], found["m_with_actions"], found["period"]) == (3, 3, 2)
    assert found["by_k"][1] == {"k": 2, "examples": 32, "pairs": 32, "certain": 32, "uniform": 0}


def test_main_text_actions_change_the_counts():
    found = enumerated(counterexample((0, 1)))
    assert found["examples"] == 16368
    assert found["uniform_k"] == []
    assert found["diameter"] == 4


def make(**arguments):
    assert vd4rl_pomdp.envs.FINITE_IDS
    return gymnasium.make("vd4rl_pomdp/ForwardJumpCounterexample-v0", disable_env_checker=True, **arguments)


def test_counterexample_passes_the_gymnasium_checker():
    env = make(render_mode="ansi")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # Gymnasium's kind
        check_env(env.unwrapped)


def test_out_of_range_action_index_is_rejected():
    env = make()
    env.reset(seed=0)
    for wrong in (-1, 2):
        with pytest.raises(UserError, match=rf"^action {wrong}: give the index of one in \[-1, 1\], 0 to 1$"):
            env.step(wrong)


def test_environment_follows_the_world():
    env, world = make(max_episode_steps=9), counterexample()
    rng = np.random.default_rng(0)
    obs, info = env.reset(seed=3)
    for step in range(9):
        shown = world.symbols[int(obs.argmax())]
        assert obs.sum() == 255
        assert shown == (info["state"] if info["exogenous"] == 0 else BLANK)
        action = int(rng.integers(2))
        before = info
        obs, reward, terminated, truncated, info = env.step(action)
        assert info["state"] == world.step[before["state"], world.actions[action]]
        assert info["exogenous"] == (before["exogenous"] + 1) % 4
        assert (reward, terminated, truncated) == (0.0, False, step == 8)
    firsts = {env.reset(seed=s)[1]["state"] for s in range(60)}
    assert firsts == set(world.states)


def test_unknown_world_is_rejected():
    with pytest.raises(UserError, match="choose one of counterexample"):
        make(world="maze")
