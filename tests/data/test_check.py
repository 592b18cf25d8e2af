import json

import h5py
import numpy as np
import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_data import fake_reward, write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.check import check_dataset
from vd4rl_pomdp.envs import dmc


def true_replay(task, physics, actions):
    """Rewards of the fake sets, computed from their fake physics and actions."""
    assert task == "walker_walk"
    episode, t = int(physics[0]), int(physics[1])
    assert t == 0, "a replay starts at an episode's first row"
    np.testing.assert_allclose(actions[:, 0], (episode * 1000 + np.arange(len(actions))) / 1e4, rtol=1e-6)
    return np.array([fake_reward(episode, i) for i in range(len(actions))])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(dmc, "replay_rewards", true_replay)
    lengths = (5, 1, 4)
    return write_fake_set(tmp_path / "walker_walk" / "expert", lengths, physics_dim=3, cuts=(3, 7), complete_last=False)


def test_check_reports_counts_and_returns(folder, tmp_path):
    report = check_dataset(folder, tmp_path / "cache")
    returns = [0.006, 0.0, 6.003]
    assert json.loads(json.dumps(report)) == {
        "rows": 10,
        "episodes": 3,
        "transitions": 7,
        "incomplete_episodes": 2,  # an episode of a single row has no LAST either
        "episodes_of_one_row": 1,
        "action_dim": 6,
        "return_mean": pytest.approx(np.mean(returns)),
        "return_min": 0.0,
        "return_max": pytest.approx(6.003),
        "replay_max_error": 0.0,
        "replay": "every episode, from its first simulator state",
        "frame_size": 84,
        "task": "walker_walk",
        "quality": "expert",
        "shards": [f"{i}_fake.hdf5" for i in range(3)],
    }


def test_check_reports_largest_replay_error(folder, tmp_path):
    with h5py.File(folder / "2_fake.hdf5", "a") as file:
        file["reward"][1] += 0.25
    assert check_dataset(folder, tmp_path / "cache")["replay_max_error"] == pytest.approx(0.25)


def test_nan_replay_is_reported_as_nan(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(dmc, "replay_rewards", lambda *arguments: true_replay(*arguments) * np.nan)
    assert np.isnan(check_dataset(folder, tmp_path / "cache")["replay_max_error"])
    assert "does not give the stored values (largest difference nan" in rejection(["data", "check", str(folder)])


@pytest.mark.parametrize(
    ("row", "key", "value", "message"),
    [
        (0, "action", 0.5, "an episode's first row has a nonzero action or reward"),
        (0, "reward", 0.5, "an episode's first row has a nonzero action or reward"),
        (1, "action", np.nextafter(np.float32(1), np.float32(2)), r"has actions of up to 1\.0000001: scale them"),
        (1, "discount", np.nextafter(1.0, 2.0), r"'discount' is 1\.0000000000000002 in row 1, not within 0 and 1"),
        (1, "action", -1.5, r"has actions of up to 1.5: scale them to \[-1, 1\]"),
    ],
)
def test_invalid_actions_rewards_and_discounts_are_rejected(tmp_path, row, key, value, message):
    folder = write_fake_set(tmp_path / "walker_walk" / "expert", (5, 4))
    with h5py.File(next(folder.glob("0_*.hdf5")), "a") as file:
        file[key][row] = value
    with pytest.raises(UserError, match=message):
        check_dataset(folder, tmp_path / "cache")


def test_maze_without_action_repeat_cannot_be_replayed(tmp_path):
    maze = {"task": "no_curtain"}
    folder = write_fake_set(tmp_path / "maze", (4,), action_dim=2, physics_dim=4, attributes=maze)
    report = check_dataset(folder, tmp_path / "cache")
    assert report["replay_max_error"] is None
    assert report["replay"] == "impossible: its shards do not state the action repeat"


@pytest.mark.parametrize(("action_dim", "physics"), [(6, 0.0), (4, 0.0), (6, 1e30)])
def test_physics_of_another_simulator_is_rejected(tmp_path, action_dim, physics):
    """Too few state dimensions, too few action dimensions, and a state that makes the simulation diverge."""
    width = 18 if action_dim == 4 or physics else 5
    folder = write_fake_set(tmp_path / "walker_walk", (4,), action_dim=action_dim, physics_dim=width)
    if physics:
        with h5py.File(folder / "0_fake.hdf5", "a") as file:
            file["physics"][...] = physics
    with pytest.raises(UserError, match=r"the episode of row 0 cannot be replayed in walker_walk \(.+\)"):
        check_dataset(folder, tmp_path / "cache")
