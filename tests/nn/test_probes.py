import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.nn.probes import probe_error, probe_r2, probe_state


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


def test_probe_finds_linear_features_and_not_noise(random):
    episode = np.arange(2000) // 100
    states = random.normal(size=(2000, 4)) * [1, 2, 0.5, 3] + 5
    features = states @ random.normal(size=(4, 8)) + 2
    assert probe_error(features, states, episode) < 1
    assert probe_error(random.normal(size=(2000, 8)), states, episode) == pytest.approx(80, abs=3)
    assert probe_error(np.where(episode[:, None] % 5 == 4, 0, features), states, episode) > 60, "tests unseen episodes"


def test_r2_per_held_out_episode(random):
    episode = np.arange(2000) // 100
    states = random.normal(size=(2000, 2))
    assert probe_r2(states, states, episode) == pytest.approx([1] * 4, abs=1e-4)
    assert np.mean(probe_r2(random.normal(size=(2000, 2)), states, episode)) == pytest.approx(0, abs=0.05)
    assert np.mean(probe_r2(states[:, :1], states, episode)) == pytest.approx(0.5, abs=0.05), "one of two coordinates"
    noise = np.where(episode == 9, 1, 0)[:, None] * random.normal(size=(2000, 2))
    apart = probe_r2(states + noise, states, episode)
    assert apart[1] < 0.3 < 0.9 < min(apart[0], *apart[2:])


def test_probe_ignores_constant_states():
    states = np.column_stack([np.sin(np.arange(60.0)), np.full(60, 3.0)])
    assert probe_error(states[:, :1], states, np.arange(60) // 20) < 10
    assert probe_error(states[:, :1], states, np.arange(60) // 30) < 10


def test_pose_and_velocity_are_probed_separately(random):
    layout = TASKS.named("walker_walk").layout
    physics = random.normal(size=(1000, 18))
    episode = np.arange(1000) // 50
    found = probe_state(layout.velocity(physics), physics, episode, layout)
    assert found["probe_velocity"] < 1
    assert found["probe_pose"] > 70


def test_uninformative_features_score_the_mean_absolute_deviation(random):
    episode, nothing = np.arange(20_000) // 100, np.zeros((20_000, 1))
    for targets, score in (
        (random.normal(size=20_000), 100 * np.sqrt(2 / np.pi)),
        (random.laplace(size=20_000), 100 / np.sqrt(2)),
        (random.choice([-3.0, 5.0], 20_000), 100.0),
    ):
        assert probe_error(nothing, targets[:, None], episode) == pytest.approx(score, abs=2)


@pytest.mark.parametrize("number", [0, 5])
def test_probe_needs_two_episodes(random, number):
    with pytest.raises(UserError, match="needs at least two episodes"):
        probe_error(random.normal(size=(20, 3)), random.normal(size=(20, 2)), np.full(20, number))
