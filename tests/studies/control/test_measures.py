import numpy as np
import pytest
import torch

from finetune.evaluation import EVALUATION_SEED, Agent
from vd4rl_pomdp.data.reference import action_error
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.studies.control.config import ControlRun
from vd4rl_pomdp.studies.control.data import played_set
from vd4rl_pomdp.studies.control.measures import HiddenAgent, _error_on_data, play_episode
from vd4rl_pomdp.studies.control.training import pretrained, trained_policy

DECISIONS = 40


@pytest.fixture(scope="module")
def played():
    return played_set("walker_walk", 0.5, 2, DECISIONS)


@pytest.fixture
def env(played):
    return make_env(played.task, size=None, length=10)


def test_the_experts_own_error_in_closed_loop_is_nothing(played, env):
    row = play_episode(lambda now: played.expert.act(now.state), env, played.expert, 3)
    assert (row["action_error"], row["length"], row["episode_seed"]) == (0.0, 10, 3)
    assert row["return"] > 0


def test_a_known_distance_from_the_expert_is_measured_at_the_visited_states(played, env):
    row = play_episode(lambda now: played.expert.act(now.state) + 0.1, env, played.expert, 3)
    assert row["action_error"] == pytest.approx(0.01, abs=1e-5)
    assert action_error(np.array([[1.0, 0.0], [0.0, 0.0]]), np.zeros((2, 2))) == 0.25


def test_the_error_on_the_data_is_taken_at_its_rows(played):
    assert _error_on_data(lambda z: z, played.expert_actions + 0.5, played) == pytest.approx(0.25, rel=1e-3)


def recurrent(played) -> Encoder:
    torch.manual_seed(0)
    width = len(played.standardise.mean)
    shape = {"frame_encoder": "state", "channels": width, "size": 1, "hidden_dim": 16}
    return Encoder(EncoderConfig(played.dataset.action_dim, history="gru", use_actions=True, **shape)).eval()


@pytest.mark.parametrize(("share", "window"), [(0.0, 0), (0.5, 0), (0.0, 4)])
def test_a_policy_is_trained_on_the_histories_that_it_is_told(played, share, window):
    run = ControlRun("walker_walk", 0.5, 0.0, 2, DECISIONS, 2, 2, 1, "mik+a", "state", share, window, 0)
    encoder, _ = pretrained(run, played)
    _, features = trained_policy(run, played, encoder)
    rows = played.dataset.num_rows
    assert encoder.config.history_window == window
    assert features.shape == (4, rows + 2 * round(share * 2 * DECISIONS), encoder.dim)
    states = played.visible(played.dataset.physics)
    agent, streamed = encoder.initial_state(1), []
    for row in range(DECISIONS + 1):
        action = played.dataset.action[row : row + 1] * (row > 0)
        z, agent = encoder.step(states[row, None, :, None, None], action, agent)
        streamed.append(z[0])
    torch.testing.assert_close(features[0, : DECISIONS + 1].float(), torch.stack(streamed), atol=2e-3, rtol=1e-2)


def test_an_agent_sees_the_standardised_state_and_hides_by_episode_and_step_alone(played, env):
    agent = HiddenAgent(Agent(recurrent(played), Policy(16, 6, 8)), played, 0.5)
    now = env.reset(0)
    seen = [agent.observe(now, episode, t)[:, 0, 0] for episode, t in ((0, 0), (0, 0), (0, 1), (1, 0))]
    whole = played.visible(now.physics)
    assert all(torch.equal(each[each != 0], whole[each != 0]) for each in seen)
    assert torch.equal(seen[0], seen[1])
    assert len({tuple((each == 0).tolist()) for each in seen}) == 3


def test_an_episode_begins_without_memory_of_the_one_before(played, env):
    agent = HiddenAgent(Agent(recurrent(played), Policy(16, 6, 8)), played, 0.5)
    first = agent.play(env, 0)
    other = agent.play(env, 1)
    assert agent.play(env, 0) == first
    assert (first["episode_seed"], other["episode_seed"]) == (EVALUATION_SEED, EVALUATION_SEED + 1)
    assert first["return"] != other["return"]
