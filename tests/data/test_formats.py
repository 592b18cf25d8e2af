"""Sets of other libraries in and out: what those libraries write is read, what is written they read."""

import os
import zipfile

import gymnasium
import numpy as np
import pytest

from tests.helpers_data import fake_episode, fake_frame, fake_reward, read_shard, write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.folder import read_plan, shard_paths
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.data.formats import FORMATS
from vd4rl_pomdp.data.transfer import export_set, import_set
from vd4rl_pomdp.envs.gymnasium_task import area_means

LENGTHS = [20, 25, 9]
BOUNDS = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """The library, whose own folder is the test's."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return pytest.importorskip("minari")


def rows_of_set(folder):
    shards = [read_shard(shard) for shard in shard_paths(folder)]
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def assert_equal(left, right, but=()):
    assert left.keys() - set(but) == right.keys() - set(but)
    for key in left.keys() - set(but):
        np.testing.assert_array_equal(left[key], right[key], err_msg=key)


class Screen(gymnasium.Env):
    """Shows (episode, t) as `fake_frame` does, in any layout; the task ends every second episode, a limit the others."""

    def __init__(self, layout=lambda frame: frame, actions=None, steps=6, buffer=False):
        self.layout, self.steps, self.episode, self.shown = layout, steps, -1, None
        self.buffer = buffer
        self.action_space = actions or gymnasium.spaces.Box(*BOUNDS, (2,), np.float32)
        self.observation_space = self.space(layout(fake_frame(0, 0)))

    def space(self, value):
        if isinstance(value, dict):
            return gymnasium.spaces.Dict({key: self.space(part) for key, part in value.items()})
        high = 255 if value.dtype == np.uint8 else np.inf
        return gymnasium.spaces.Box(0, high, value.shape, value.dtype)

    def reset(self, *, seed=None, options=None):
        self.episode, self.t = self.episode + 1, 0
        return self.picture(), {}

    def picture(self):
        fresh = self.layout(fake_frame(self.episode, self.t))
        if self.buffer and self.shown is not None:
            self.shown[:] = fresh
        else:
            self.shown = {key: part.copy() for key, part in fresh.items()} if isinstance(fresh, dict) else fresh.copy()
        return self.shown

    def step(self, action):
        self.t += 1
        end = self.t == self.steps
        return self.picture(), fake_reward(self.episode, self.t - 1), end and self.episode % 2 == 0, end, {}


def record(minari, env, name="test/screen-v0", episodes=2, cut=False, **options):
    """What Minari's collector writes of an environment, and the actions that were taken."""
    pytest.importorskip("jax")  # which the collector needs
    collector = minari.DataCollector(env, **options)
    taken = []
    for _ in range(episodes):
        collector.reset(seed=0)
        ended = False
        while not ended:
            taken.append(env.action_space.sample())
            *_, terminated, truncated, _ = collector.step(taken[-1])
            ended = terminated or truncated
    if cut:
        collector.reset(seed=0)
        collector.step(env.action_space.sample())
    author = {"author": "a", "author_email": "a@example.org", "code_permalink": "none", "algorithm_name": "none"}
    collector.create_dataset(name, **author)
    return np.array(taken)


LAYOUTS = {
    "channels first": lambda frame: frame,
    "channels last": lambda frame: frame.transpose(1, 2, 0),
    "stack of three": lambda frame: np.concatenate([0 * frame, 0 * frame, frame]),
    "in a dict": lambda frame: {"pixels": frame, "state": np.zeros(4, np.float32)},
}


@pytest.mark.parametrize("storage", ["hdf5", "arrow"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_minaris_recordings_come_in_to_the_byte(minari, layout, storage, tmp_path):
    if storage == "arrow":
        pytest.importorskip("pyarrow")
    taken = record(minari, Screen(LAYOUTS[layout]), data_format=storage, jpeg_encoding=False)
    import_set("minari", "test/screen-v0", tmp_path / "set")
    rows = rows_of_set(tmp_path / "set")
    wanted = [fake_episode(number, 7, 2) for number in range(2)]
    for key in ("observation", "reward", "step_type"):
        np.testing.assert_array_equal(rows[key], np.concatenate([one[key] for one in wanted]))
    # a_t stood beside o_t: here it stands with o_{t+1}, in units of its bounds
    action = rows["action"].reshape(2, 7, 2)
    assert not action[:, 0].any()
    scaled = (taken.astype(float) - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) * 2 - 1
    np.testing.assert_allclose(action[:, 1:].reshape(-1, 2), scaled, atol=1e-6)
    # the task ended the first episode, a time limit the second
    assert rows["discount"].tolist() == [1] * 6 + [0] + [1] * 7


def test_a_recording_that_reset_cuts_ends_by_truncation(minari, tmp_path):
    record(minari, Screen(), cut=True)
    import_set("minari", str(tmp_path / "minari" / "test" / "screen-v0"), tmp_path / "set")
    rows = rows_of_set(tmp_path / "set")
    assert rows["step_type"][-2:].tolist() == [StepType.FIRST, StepType.LAST]
    assert rows["discount"][-1] == 1


def test_minaris_jpeg_is_told(minari, tmp_path, capsys):
    record(minari, Screen(LAYOUTS["channels last"]))
    import_set("minari", "test/screen-v0", tmp_path / "set")
    assert "its pictures are JPEG" in capsys.readouterr().err


def test_a_buffer_that_minari_kept_is_told(minari, tmp_path, capsys):
    record(minari, Screen(buffer=True))
    import_set("minari", "test/screen-v0", tmp_path / "set")
    assert "in every episode all pictures are equal" in capsys.readouterr().err


def test_discrete_actions_become_columns(minari, tmp_path, capsys):
    taken = record(minari, Screen(actions=gymnasium.spaces.Discrete(4, start=1)))
    import_set("minari", "test/screen-v0", tmp_path / "set")
    action = rows_of_set(tmp_path / "set")["action"].reshape(2, 7, 4)[:, 1:].reshape(-1, 4)
    np.testing.assert_array_equal(action, np.where(np.arange(1, 5) == taken[:, None], 1, -1))
    assert "the 4 discrete actions become as many columns" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (lambda frame: {"left": frame, "right": frame}, "Pass --picture, one of left, right"),
        (lambda frame: frame[:2], "holds no pictures"),
        (lambda frame: frame.astype(np.float32), "holds no pictures"),
        (lambda frame: frame[:, :60], "pictures of 60x84 pixels.*pass --size"),
    ],
)
def test_what_is_no_set_of_pictures_is_refused(minari, layout, message, tmp_path):
    record(minari, Screen(layout))
    with pytest.raises(UserError, match=message):
        import_set("minari", "test/screen-v0", tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_minari_out_and_in_loses_nothing(minari, tmp_path):
    attributes = {"task": "walker_walk", "set": "mine"}
    folder = write_fake_set(tmp_path / "own", LENGTHS, complete_last=False, physics_dim=18, attributes=attributes)
    main(["data", "export", "minari", str(folder), str(tmp_path / "minari" / "walker" / "mine-v0")])
    loaded = minari.load_dataset("walker/mine-v0")
    assert (len(loaded), loaded.total_steps) == (3, sum(LENGTHS) - 3)
    episode = loaded[1]
    np.testing.assert_array_equal(episode.observations, fake_episode(1, 25)["observation"])
    np.testing.assert_array_equal(episode.actions, fake_episode(1, 25)["action"][1:])
    assert episode.truncations[-1]
    assert not episode.terminations.any()
    main(["data", "import", "minari", "walker/mine-v0", str(tmp_path / "back")])
    assert_equal(rows_of_set(folder), rows_of_set(tmp_path / "back"))
    dataset = open_dataset(tmp_path / "back", tmp_path / "cache")
    assert (dataset.task, dataset.quality, dataset.incomplete_episodes) == ("walker_walk", "mine", 1)


def test_minari_says_what_it_cannot_keep(minari, tmp_path, capsys):
    episodes = [fake_episode(0, 5), fake_episode(1, 1), fake_episode(2, 5)]
    episodes[0]["discount"][2], episodes[1]["step_type"][0] = 0.5, StepType.FIRST
    (tmp_path / "own").mkdir()
    rows = {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}
    write_shard(tmp_path / "own" / "0_a.hdf5", rows, {"task": "walker_walk"})
    export_set("minari", tmp_path / "own", tmp_path / "a-v0")
    told = capsys.readouterr().err
    assert "episodes of a single row" in told
    assert "discounts other than" in told
    with pytest.raises(UserError, match="call the folder walker-v0"):
        export_set("minari", tmp_path / "own", tmp_path / "walker")
    assert not (tmp_path / "walker").exists()
