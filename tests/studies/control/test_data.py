import numpy as np
import pytest
import torch

from vd4rl_pomdp.core.seeding import episode_seed
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data import WindowSampler
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.studies.control.data import HiddenView, PlayedSet, hide, played_set

DECISIONS = 40


@pytest.fixture(scope="module")
def played() -> PlayedSet:
    return played_set("walker_walk", 0.5, 2, DECISIONS)


def test_hidden_coordinates_are_zero_and_the_others_as_they_were():
    states = torch.rand(2000, 18) + 1
    seen = hide(states, torch.arange(2000), 0.3)
    hidden = seen == 0
    assert torch.equal(seen[~hidden], states[~hidden])
    assert hidden.float().mean(0).sub(0.3).abs().max() < 0.05, "each coordinate as often"
    assert np.corrcoef(hidden.float().numpy().T)[~np.eye(18, dtype=bool)].max() < 0.1, "each on its own"


def test_equal_keys_hide_the_same_whatever_stands_beside_them():
    states, key = torch.rand(6, 18) + 1, torch.tensor([3, 4, 3, 5, 4, 6])
    hidden = hide(states, key, 0.5) == 0
    assert torch.equal(hidden[0], hidden[2])
    assert torch.equal(hidden[1], hidden[4])
    assert not torch.equal(hidden[0], hidden[1])
    assert torch.equal(hide(states[2:3], key[2:3], 0.5)[0] == 0, hidden[2])


def test_nothing_or_all_can_be_hidden():
    states, key = torch.rand(100, 18) + 1, torch.arange(100)
    assert torch.equal(hide(states, key, 0.0), states)
    assert not hide(states, key, 1.0).any()


def test_a_set_holds_what_was_played_and_the_experts_mean_actions(played):
    dataset, env = played.dataset, make_env(TASKS.named("walker_walk"), size=None, length=DECISIONS)
    rows = iter(range(len(played.expert_actions)))
    for episode in range(2):
        start = int(dataset.episode_start[episode])
        now, stored = env.reset(episode_seed(0, episode)), dataset.action[start + 1 :]
        for t in range(DECISIONS):
            np.testing.assert_allclose(now.physics, dataset.physics[start + t])
            wanted = played.expert_actions[next(rows)].numpy()
            np.testing.assert_allclose(played.expert.act(now.state), wanted, atol=1e-5)
            now = env.step(stored[t].numpy())
            assert now.reward == pytest.approx(float(dataset.reward[start + t + 1]))
    assert (dataset.num_rows, dataset.task, next(rows, None)) == (2 * (DECISIONS + 1), "walker_walk", None)


def test_the_stored_actions_are_the_experts_with_noise(played):
    quiet = played_set("walker_walk", 0.0, 2, DECISIONS)
    spread = [
        float((each.dataset.action_after(each.dataset.transition_rows) - each.expert_actions).square().mean())
        for each in (quiet, played)
    ]
    assert spread[0] < 0.1 < spread[1] < 0.3


def test_states_are_standardised_before_they_are_hidden(played):
    seen = played.visible(played.dataset.physics)
    assert seen.mean(0).abs().max() < 1e-3
    assert (seen.std(0) - 1).abs().max() < 0.2
    whole = HiddenView(played, 0.0, 0, "x").observe(torch.arange(played.dataset.num_rows))
    assert torch.equal(whole[..., 0, 0], seen)


def test_a_view_hides_rows_anew_in_every_batch_and_another_seed_others(played):
    rows = torch.arange(30)
    first, other = HiddenView(played, 0.5, 0, "x"), HiddenView(played, 0.5, 1, "x")
    batches = [first.observe(rows), first.observe(rows), other.observe(rows)]
    assert all(batch.shape == (30, len(played.standardise.mean), 1, 1) for batch in batches)
    masks = [batch == 0 for batch in batches]
    assert not torch.equal(masks[0], masks[1])
    assert not torch.equal(masks[0], masks[2])
    assert torch.equal(HiddenView(played, 0.5, 0, "x").observe(rows) == 0, masks[0])


def test_windows_of_a_view_show_its_rows_with_their_actions(played):
    view = HiddenView(played, 0.0, 0, "x")
    window = WindowSampler(view, 4, 8, torch.Generator().manual_seed(0)).sample()
    whole = played.visible(played.dataset.physics)
    rows = played.dataset.episode_start[window.key >> 20] + (window.key & 0xFFFFF)
    assert torch.equal(window.obs[..., 0, 0], whole[rows])
    assert torch.equal(window.prev_action[:, 1:], played.dataset.action[rows[:, 1:]])
