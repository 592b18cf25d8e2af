import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.helpers_data import file_bytes
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.check import check_dataset
from vd4rl_pomdp.envs.maze import MazeEnv
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation.collect import MazeCollectConfig, _explore, _roll_out, collect


def small(out: Path, **changes: object) -> MazeCollectConfig:
    given = {"maze": "three_curtains", "out": out, "trajectories": 4, "trajectory_rows": 30, "workers": 1}
    return MazeCollectConfig.of("cpu", **(given | {"trajectories_per_shard": 2} | changes))


@pytest.fixture(scope="module")
def maze_set(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("maze") / "set"
    collect(small(out))
    return out


def test_stored_actions_reproduce_states_and_frames(maze_set, tmp_path):
    dataset = open_dataset(maze_set, tmp_path)
    assert (dataset.num_rows, dataset.num_episodes, dataset.task) == (120, 4, "three_curtains")
    env = MazeEnv("three_curtains", 5)
    for start, end in zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True):
        frame, _ = env.reset(seed=0, options={"state": dataset.physics[start]})
        assert not dataset.action[start].any()
        for row in range(start, end):
            np.testing.assert_allclose(env.state, dataset.physics[row], atol=1e-9)
            np.testing.assert_array_equal(frame, dataset.frames[row].numpy())
            if row + 1 < end:
                frame, *_ = env.step(dataset.action[row + 1].numpy())


def test_data_check_replays_maze_states(maze_set, tmp_path):
    report = check_dataset(maze_set, tmp_path / "cache")
    names = ("task", "rows", "episodes", "replay_max_error")
    assert [report[name] for name in names] == ["three_curtains", 120, 4, 0]
    damaged = tmp_path / "damaged"
    shutil.copytree(maze_set, damaged)
    with h5py.File(damaged / "1_three_curtains.hdf5", "a") as file:
        file["physics"][20, 2] += 0.5
    assert check_dataset(damaged, tmp_path / "cache")["replay_max_error"] == pytest.approx(0.5)


def test_resumed_maze_collection_writes_identical_files(maze_set, tmp_path):
    again = shutil.copytree(maze_set, tmp_path / "set")
    (again / "1_three_curtains.hdf5").unlink()
    collect(small(again, workers=2))
    assert file_bytes(again, "*.hdf5") == file_bytes(maze_set, "*.hdf5")


def test_action_repeat_and_seed_change_the_dataset(maze_set, tmp_path):
    collect(small(tmp_path / "repeat", trajectories=2, action_repeat=2))
    collect(small(tmp_path / "seed", trajectories=2, seed=1))
    folders = (maze_set, tmp_path / "repeat", tmp_path / "seed")
    assert len({(folder / "0_three_curtains.hdf5").read_bytes() for folder in folders}) == 3


@pytest.mark.parametrize(
    ("maze", "changes"), [("hard_no_curtain", {"noise": 1e4}), ("no_curtain", {"random_share": 1})]
)
def test_trajectories_have_independent_noise(maze, changes, tmp_path, monkeypatch):
    """With noise far larger than, or in place of, the planner's action, actions have the noise's signs."""
    loud = replace(MAZES[maze].style, zero_share=0.0, **changes)
    monkeypatch.setitem(MAZES, maze, replace(MAZES[maze], style=loud))
    signs = np.sign([_roll_out((maze, i, 0, 30, 5))["action"][1:] for i in range(3)])
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert 0.2 < (signs[one] == signs[other]).mean() < 0.8


def test_exploration_replaces_a_fifth_of_the_actions():
    rng, style, wanted = np.random.default_rng(0), MAZES["no_curtain"].style, np.array([3.0, -0.25])
    actions = np.array([_explore(wanted, style, rng) for _ in range(4000)])
    assert (actions == 0).all(1).mean() == pytest.approx(0.1, abs=0.015)
    assert (actions == [1.0, -0.25]).all(1).mean() == pytest.approx(0.8, abs=0.02)
    noisy = np.array([_explore(np.zeros(2), MAZES["hard_no_curtain"].style, rng) for _ in range(4000)])
    assert noisy.std(0) == pytest.approx(0.48, abs=0.03)
    assert not (noisy == 0).all(1).any()


def test_first_person_data_contains_headings_and_motion(tmp_path):
    collect(small(tmp_path / "set", maze="first_person", trajectories=1, trajectory_rows=120))
    dataset = open_dataset(tmp_path / "set", tmp_path / "cache")
    assert dataset.physics.shape == (120, 6)
    assert np.ptp(dataset.physics[:, 2]) > 1
    assert np.ptp(dataset.physics[:, :2], axis=0).max() > 1
    assert len({frame.numpy().tobytes() for frame in dataset.frames}) > 100
