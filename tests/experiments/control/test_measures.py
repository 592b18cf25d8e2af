import numpy as np
import pytest
import torch

from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.evaluation import EVALUATION_SEED, Agent
from vd4rl_pomdp.experiments.control.data import played_set
from vd4rl_pomdp.experiments.control.measures import HiddenAgent, _error_on_data, action_error, play_episode
from vd4rl_pomdp.experiments.control.training import Ends, both_ends
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.policy import Policy

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


def test_the_error_on_the_data_is_that_of_the_first_view(played):
    class Same(torch.nn.Module):
        def forward(self, z):
            return z

    wanted = played.expert_actions
    ends = Ends(torch.stack([wanted + 0.5, wanted]), torch.zeros(0))
    assert _error_on_data(Same(), ends, played) == pytest.approx(0.25, rel=1e-3)


def recurrent(played) -> Encoder:
    torch.manual_seed(0)
    width = len(played.standardise.mean)
    shape = {"frame_encoder": "state", "channels": width, "size": 1, "hidden_dim": 16}
    return Encoder(EncoderConfig(played.dataset.action_dim, history="gru", use_actions=True, **shape)).eval()


@torch.no_grad()
def test_both_ends_are_what_a_stream_over_their_episode_gives(played):
    dataset, encoder = played.dataset, recurrent(played)
    features = played.visible(dataset.physics)
    next_rows = dataset.n_step_returns(dataset.transition_rows, 3, 0.99)[2]
    ends = both_ends(encoder, features, dataset, next_rows)
    streamed = []
    for start, end in zip(dataset.episode_start, dataset.episode_end, strict=True):
        state, action = encoder.initial_state(1), torch.zeros(1, dataset.action_dim)
        for row in range(start, end):
            z, state = encoder.step(features[row, None, :, None, None], action, state)
            streamed.append(z[0])
            action = dataset.action[row + 1 : row + 2]
    expected = torch.stack(streamed)
    torch.testing.assert_close(ends.z, expected[dataset.transition_rows], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ends.next_z, expected[next_rows], atol=1e-5, rtol=1e-4)


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
