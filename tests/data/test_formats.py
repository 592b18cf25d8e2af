"""Import and export of other libraries' formats: Minari, OGBench, V-D4RL's .npz."""

import os
import shutil
import tracemalloc
from pathlib import Path

import gymnasium
import h5py
import numpy as np
import pytest

from finetune.train import finetune
from pretrain.train import pretrain
from tests.helpers_bad_input import rejection
from tests.helpers_data import (
    assert_equal_rows,
    fake_episode,
    fake_frame,
    fake_reward,
    fake_rows,
    rows_of_set,
    write_fake_set,
    write_rows,
)
from tests.helpers_stages import smoke_finetune, smoke_pretrain
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.data.transfer import export_set, import_set
from vd4rl_pomdp.envs.gymnasium_task import area_means
from vd4rl_pomdp.nn.policy import policy_step
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.results import find_results
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers
from vd4rl_pomdp.sweeps.plan import DataSet, plan_jobs

LENGTHS = [20, 25, 9]
BOUNDS = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """Minari, with its datasets in `tmp_path`."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return pytest.importorskip("minari")


class Screen(gymnasium.Env):
    """Shows `fake_frame(episode, t)` in any layout; even episodes terminate, odd ones are truncated."""

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
    """Record episodes with Minari's collector and return their actions."""
    pytest.importorskip("jax")  # the collector needs it
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
def test_minari_recordings_are_imported_exactly(minari, layout, storage, tmp_path):
    if storage == "arrow":
        pytest.importorskip("pyarrow")
    taken = record(minari, Screen(LAYOUTS[layout]), data_format=storage, jpeg_encoding=False)
    import_set("minari", "test/screen-v0", tmp_path / "set")
    rows = rows_of_set(tmp_path / "set")
    wanted = [fake_episode(number, 7, 2) for number in range(2)]
    for key in ("observation", "reward", "step_type"):
        np.testing.assert_array_equal(rows[key], np.concatenate([one[key] for one in wanted]))
    # Minari stores a_t with o_t; V-D4RL stores it with o_{t+1}, scaled to [-1, 1]
    action = rows["action"].reshape(2, 7, 2)
    assert not action[:, 0].any()
    scaled = (taken.astype(float) - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) * 2 - 1
    np.testing.assert_allclose(action[:, 1:].reshape(-1, 2), scaled, atol=1e-6)
    # the first episode terminates, the second is truncated
    assert rows["discount"].tolist() == [1] * 6 + [0] + [1] * 7


def test_minari_episode_cut_by_reset_is_truncated(minari, tmp_path):
    record(minari, Screen(), cut=True)
    made = tmp_path / "minari" / "test" / "screen-v0"
    (made / "data" / "._main_data.hdf5").write_bytes(b"\0\5\x16\7")  # as macOS writes it
    import_set("minari", str(made), tmp_path / "set")
    rows = rows_of_set(tmp_path / "set")
    assert rows["step_type"][-2:].tolist() == [StepType.FIRST, StepType.LAST]
    assert rows["discount"][-1] == 1


def test_minari_arrays_in_other_files_are_not_read(minari, tmp_path):
    export_set("minari", write_fake_set(tmp_path / "own", LENGTHS), tmp_path / "mine-v0")
    (tmp_path / "others").mkdir()
    for number, path in enumerate(("episode_1/observations", "episode_1")):
        with h5py.File(tmp_path / "mine-v0" / "data" / "main_data.hdf5", "a") as file:
            with h5py.File(tmp_path / "others" / f"{number}.h5", "w") as other:
                file.copy(path, other, "moved")
            del file[path]
            file[path] = h5py.ExternalLink(str(tmp_path / "others" / f"{number}.h5"), "moved")
        with pytest.raises(UserError, match=rf"main_data.hdf5: '{path}' is stored in another file"):
            import_set("minari", str(tmp_path / "mine-v0"), tmp_path / "back")


def corrupted_screen():
    env = Screen()
    env.spec = gymnasium.spec("vd4rl_pomdp/WalkerWalk-Patch16-v0")
    return env


@pytest.mark.parametrize(
    ("make", "note"),
    [
        (lambda: Screen(LAYOUTS["channels last"]), "its images are JPEG"),
        (lambda: Screen(buffer=True), "in every episode all images are equal"),
        (corrupted_screen, "recorded under the corruption patch"),
    ],
)
def test_lossy_minari_recordings_print_a_note(minari, tmp_path, capsys, make, note):
    record(minari, make())
    import_set("minari", "test/screen-v0", tmp_path / "set")
    assert note in capsys.readouterr().err
    assert open_dataset(tmp_path / "set", tmp_path / "cache").task == (
        "walker_walk" if "patch" in note else "test_screen-v0"
    )


def test_discrete_actions_become_one_hot_columns(minari, tmp_path, capsys):
    taken = record(minari, Screen(actions=gymnasium.spaces.Discrete(4, start=1)))
    import_set("minari", "test/screen-v0", tmp_path / "set")
    action = rows_of_set(tmp_path / "set")["action"].reshape(2, 7, 4)[:, 1:].reshape(-1, 4)
    np.testing.assert_array_equal(action, np.where(np.arange(1, 5) == taken[:, None], 1, -1))
    assert "the 4 discrete actions become one-hot columns" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (lambda frame: {"left": frame, "right": frame}, "choose one with --picture, of left, right"),
        (lambda frame: frame[:2], "holds no images"),
        (lambda frame: frame.astype(np.float32), "holds no images"),
        (lambda frame: frame[:, :60], "images of 60x84 pixels.*pass --size"),
    ],
)
def test_minari_set_without_usable_images_is_rejected(minari, layout, message, tmp_path):
    record(minari, Screen(layout))
    with pytest.raises(UserError, match=message):
        import_set("minari", "test/screen-v0", tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_importing_another_camera_into_same_folder_is_rejected(minari, tmp_path):
    record(minari, Screen(lambda frame: {"left": frame, "right": 255 - frame}), jpeg_encoding=False)
    import_set("minari", "test/screen-v0", tmp_path / "set", picture="left")
    with pytest.raises(UserError, match="holds a dataset that differs in source; choose another --out"):
        import_set("minari", "test/screen-v0", tmp_path / "set", picture="right")


def test_minari_round_trip_is_lossless(minari, tmp_path):
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
    assert_equal_rows(rows_of_set(folder), rows_of_set(tmp_path / "back"))
    dataset = open_dataset(tmp_path / "back", tmp_path / "cache")
    assert (dataset.task, dataset.quality, dataset.incomplete_episodes) == ("walker_walk", "mine", 1)


def test_minari_relative_paths_and_damaged_metadata(minari, tmp_path, monkeypatch):
    folder = write_fake_set(tmp_path / "own", [4])
    monkeypatch.chdir(tmp_path)
    export_set("minari", folder, Path("out-v0"))
    import_set("minari", "out-v0", Path("again"))
    Path("out-v0/data/metadata.json").write_text("[]")
    with pytest.raises(UserError, match="out-v0: cannot be read as this format"):
        import_set("minari", "out-v0", Path("set"))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"reward": np.full(5, np.nan)}, "'reward' is not finite"),
        ({"reward": np.zeros(4)}, "'image' has 5 rows, 'reward' 4"),
        ({"is_last": np.ones(3)}, "'is_last' has 3 rows, 'reward' 5"),
        ({"is_first": np.ones(6)}, "'is_first' has 6 rows, 'reward' 5"),
        ({"discount": np.ones(1)}, "'discount' has 1 rows, 'reward' 5"),
        ({"action": np.zeros((5, 3), np.float32)}, "unlike the episodes before"),
        ({"image": np.zeros((5, 84, 84, 3), np.float32)}, "float32 images"),
        ({"image": np.zeros((5, 32, 32, 3), np.uint8)}, "images of 32x32 pixels, its dataset declares 84x84"),
    ],
)
def test_import_of_damaged_episode_leaves_nothing(changed, message, tmp_path):
    export_set("vd4rl_npz", write_fake_set(tmp_path / "own", [5, 5]), tmp_path / "npz")
    with np.load(file := tmp_path / "npz" / "000001-5.npz") as stored:
        np.savez(file, **(dict(stored) | changed))
    words = ["data", "import", "vd4rl_npz", str(tmp_path / "npz")]
    line = rejection([*words, str(tmp_path / "new" / "set")])
    assert "npz: episode 1: " in line
    assert message in line
    assert not (tmp_path / "new").exists()
    (tmp_path / "empty").mkdir()
    rejection([*words, str(tmp_path / "empty")])
    assert list((tmp_path / "empty").iterdir()) == [], "the user's existing folder stays"


def test_minari_export_notes_losses(minari, tmp_path, capsys):
    episodes = [fake_episode(0, 5), fake_episode(1, 1), fake_episode(2, 5)]
    episodes[0]["discount"][2], episodes[1]["step_type"][0] = 0.5, StepType.FIRST
    rows = {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}
    folder = write_rows(tmp_path / "own", rows, {"task": "walker_walk"})
    export_set("minari", folder, tmp_path / "a-v0")
    stderr = capsys.readouterr().err
    assert "episodes of a single row" in stderr
    assert "discounts other than" in stderr
    with pytest.raises(UserError, match="accept the name 'walker': end it in a version, as in walker-v0"):
        export_set("minari", folder, tmp_path / "walkers" / "walker")
    assert [name for name in os.listdir(tmp_path) if "walker" in name] == []
    with pytest.raises(UserError, match="test/none-v0: is neither a Minari folder nor an installed Minari dataset"):
        import_set("minari", "test/none-v0", tmp_path / "set")


@pytest.mark.parametrize("name", ["q/exp-v0", "my set/walker-v0", "walker"])
def test_names_that_minari_refuses_are_rejected(minari, tmp_path, name):
    folder = write_fake_set(tmp_path / "own", [4])
    with pytest.raises(UserError, match=f"Minari does not accept the name '{name}': .* at least two characters before"):
        export_set("minari", folder, tmp_path / "minari" / name)


@pytest.mark.parametrize("name", ["vd4rl", "vd4rl_npz", "lerobot", "lerobot_video", "minari"])
def test_single_row_episodes_are_kept_or_noted(minari, tmp_path, capsys, name):
    if name.startswith("lerobot"):
        pytest.importorskip("pyarrow")
        pytest.importorskip("av")
    source = own = write_fake_set(tmp_path / "own", [1, 5, 1, 6], attributes={"task": "walker_walk"})
    if name != "vd4rl":
        export_set(name, own, source := tmp_path / "a-v0")
    noted = "episodes of a single row are left out" in capsys.readouterr().err
    import_set(name, str(source), tmp_path / "back")
    back, lengths = rows_of_set(tmp_path / "back"), [5, 6] if name == "minari" else [1, 5, 1, 6]
    assert np.diff(np.flatnonzero(back["step_type"] == StepType.FIRST), append=sum(lengths)).tolist() == lengths
    assert noted == (name == "minari")
    if not noted:
        assert_equal_rows(rows_of_set(own), back, but=["observation"] if name == "lerobot_video" else [])


def write_ogbench(path, episodes):
    """Write (T + 1, 64, 64, 3) images and (T + 1, A) actions as OGBench's generation scripts do."""
    pictures, actions = ([one[part] for one in episodes] for part in (0, 1))
    terminals = np.concatenate([np.arange(len(one)) == len(one) - 1 for one in actions])
    np.savez_compressed(
        path, observations=np.concatenate(pictures), actions=np.concatenate(actions), terminals=terminals
    )
    return path


def test_ogbench_import_matches_ogbench_loader(tmp_path):
    ogbench = pytest.importorskip("ogbench.utils")
    rng = np.random.default_rng(0)
    sizes = [5, 8, 3]
    episodes = [
        (rng.integers(0, 256, (n, 64, 64, 3), np.uint8), rng.uniform(-1, 1, (n, 4)).astype(np.float32)) for n in sizes
    ]
    path = write_ogbench(tmp_path / "visual-x-play-v0.npz", episodes)
    theirs = ogbench.load_dataset(path, ob_dtype=np.uint8)
    import_set("ogbench", str(path), tmp_path / "set")
    dataset = open_dataset(tmp_path / "set", tmp_path / "cache")
    rows = dataset.transition_rows
    assert len(rows) == len(theirs["actions"])
    np.testing.assert_array_equal(dataset.frames[rows].permute(0, 2, 3, 1), theirs["observations"])
    np.testing.assert_array_equal(dataset.frames[rows + 1].permute(0, 2, 3, 1), theirs["next_observations"])
    np.testing.assert_array_equal(dataset.action_after(rows), theirs["actions"])
    ends = dataset.step_type[rows + 1] == StepType.LAST
    np.testing.assert_array_equal(ends, theirs["terminals"])
    assert (dataset.discount == 1).all()  # a time limit
    assert (dataset.task, dataset.frame_size) == ("visual-x-play-v0", 64)


EPISODE = np.zeros((4, 64, 64, 3), np.uint8), np.zeros((4, 2), np.float32)


@pytest.mark.parametrize(
    ("episodes", "changed", "message"),
    [
        ([EPISODE] * 2, {"actions": np.zeros((4, 2))}, "has 8 images, 4 actions and 8 terminals"),
        ([EPISODE] * 2, {"terminals": np.zeros(4)}, "has 8 images, 8 actions and 4 terminals"),
        ([(np.zeros((3, 28), np.float32), np.zeros((3, 5), np.float32))], {}, "holds no images"),
        ([EPISODE], None, "cannot be read as this format"),
    ],
)
def test_damaged_ogbench_sets_are_rejected(tmp_path, episodes, changed, message):
    path = write_ogbench(tmp_path / "x-v0.npz", episodes)
    if changed is None:
        path.write_bytes(path.read_bytes()[:200])
    else:
        with np.load(path) as stored:
            np.savez(path, **(dict(stored) | changed))
    with pytest.raises(UserError, match=f"x-v0.npz: {message}"):
        import_set("ogbench", str(path), tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("key", ["observations", "actions", "rewards", "terminations", "truncations", "infos/physics"])
def test_minari_arrays_of_unequal_length_are_rejected(minari, key, tmp_path):
    folder = write_fake_set(tmp_path / "own", [5, 5], physics_dim=18, attributes={"task": "walker_walk"})
    export_set("minari", folder, tmp_path / "a-v0")
    with h5py.File(tmp_path / "a-v0" / "data" / "main_data.hdf5", "r+") as file:
        episode = file["episode_1"]
        shorter = episode[key][:-1]
        del episode[key]
        episode[key] = shorter
    with pytest.raises(UserError, match="a-v0: episode 1: "):
        import_set("minari", str(tmp_path / "a-v0"), tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_npz_round_trip_loses_only_physics(tmp_path, capsys):
    folder = write_fake_set(tmp_path / "walker_walk" / "expert", LENGTHS, complete_last=False, physics_dim=18)
    main(["data", "export", "vd4rl_npz", str(folder), str(tmp_path / "npz")])
    stderr = capsys.readouterr().err
    assert "simulator states" in stderr
    assert "task and quality are not stored: import with --task walker_walk and --quality expert" in stderr
    names = sorted(os.listdir(tmp_path / "npz"))
    assert [name.rpartition("-")[2] for name in names] == [f"{length}.npz" for length in LENGTHS]
    with np.load(tmp_path / "npz" / names[0]) as first:
        assert first["image"].shape == (20, 84, 84, 3)
        assert [first[key].nonzero()[0].tolist() for key in ("is_first", "is_last", "is_terminal")] == [[0], [19], []]
    (tmp_path / "npz" / f"._{names[0]}").write_bytes(b"\0\5\x16\7")  # as macOS writes it
    main(["data", "import", "vd4rl_npz", str(tmp_path / "npz"), str(tmp_path / "cheetah_run")])
    assert_equal_rows(rows_of_set(folder), rows_of_set(tmp_path / "cheetah_run"), but=["physics"])


def rewrite_npz(folder, change):
    """Export a set of two episodes as .npz files, with `change` made to each one's arrays, and return both sets."""
    own, npz = (folder / name / "walker_walk" / "expert" for name in ("own", "npz"))
    export_set("vd4rl_npz", write_fake_set(own, [5, 6]), npz)
    for file in npz.iterdir():
        with np.load(file) as stored:
            arrays = dict(stored)
        np.savez(file, **(arrays | change(arrays)))
    return own, npz


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: {"image": one["image"] / np.float32(255)}, "episode 0: has float32 images, expected uint8"),
        (lambda one: {"image": np.repeat(one["image"][..., :1], 4, -1)}, "holds no images: expected uint8"),
        (lambda one: {"is_first": np.arange(len(one["reward"])) % 3 == 0}, "'is_first' is true in the middle"),
        (lambda one: {"is_last": np.arange(len(one["reward"])) % 3 == 2}, "'is_last' is true in the middle"),
    ],
)
def test_npz_of_other_layouts_is_rejected(tmp_path, change, message):
    _, npz = rewrite_npz(tmp_path, change)
    with pytest.raises(UserError, match=message):
        import_set("vd4rl_npz", str(npz), tmp_path / "set")


@pytest.mark.parametrize(
    "change",
    [
        lambda one: {"discount": one["discount"].astype(np.int64)},
        lambda one: {"discount": one["discount"].astype(bool)},
        lambda one: {"action": one["action"][:, 0]},
    ],
)
def test_npz_of_other_dtypes_and_shapes_is_read(tmp_path, capsys, change):
    own, npz = rewrite_npz(tmp_path, change)
    assert "not stored" not in capsys.readouterr().err, "the folder's name states the task"
    import_set("vd4rl_npz", str(npz), tmp_path / "set")
    rows, given = rows_of_set(tmp_path / "set"), rows_of_set(own)
    given["action"] = given["action"][:, : rows["action"].shape[1]]
    assert_equal_rows(given, rows)


@pytest.mark.parametrize(
    ("stack", "grey"),
    [
        (lambda frames: np.stack([0 * frames, 0 * frames, 0 * frames, frames], 1), False),
        (lambda frames: np.stack([0 * frames, frames], 1).transpose(0, 1, 3, 4, 2), False),
        (lambda frames: np.concatenate([0 * frames, frames[:, 2:]], 1), True),
        (lambda frames: np.stack([0 * frames, frames], 1)[:, :, 2:].transpose(0, 1, 3, 4, 2), True),
    ],
)
def test_newest_frame_of_a_stack_is_kept(tmp_path, stack, grey):
    own, npz = rewrite_npz(tmp_path, lambda one: {"image": stack(one["image"].transpose(0, 3, 1, 2))})
    import_set("vd4rl_npz", str(npz), tmp_path / "set")
    newest = rows_of_set(own)["observation"]
    newest = np.repeat(newest[:, 2:], 3, 1) if grey else newest
    np.testing.assert_array_equal(rows_of_set(tmp_path / "set")["observation"], newest)


def test_published_64_pixel_sets_print_a_note(tmp_path, capsys):
    folder = write_fake_set(tmp_path / "own", [5, 5], attributes={"task": "walker_walk"})
    place = tmp_path / "main" / "walker_walk" / "medium_expert" / "64px"
    export_set("vd4rl_npz", folder, place, size=64)
    import_set("vd4rl_npz", str(place), tmp_path / "set")
    stderr = capsys.readouterr().err
    assert "the published 64-pixel datasets are incomplete" in stderr
    assert "2 episodes of the expert only" in stderr
    dataset = open_dataset(tmp_path / "set", tmp_path / "cache")
    assert (dataset.task, dataset.quality, dataset.frame_size) == ("walker_walk", "medium_expert", 64)


def test_resized_frames_are_area_means(tmp_path, capsys):
    attributes = {"task": "walker_walk", "set": "expert"}
    own = str(write_fake_set(tmp_path / "own", [6], noise=84, attributes=attributes))
    import_set("vd4rl", own, tmp_path / "small", size=50)
    told = capsys.readouterr().err
    assert "images of 84x84 pixels become 50x50 (area means)" in told
    assert "evaluations render walker_walk at 50x50, which gives other pixels than these means" in told
    import_set("vd4rl", own, tmp_path / "maze", task="elsewhere", size=50)
    assert "evaluations" not in capsys.readouterr().err
    small = rows_of_set(tmp_path / "small")
    means = [
        area_means(one.transpose(1, 2, 0), 50).transpose(2, 0, 1) for one in fake_rows([6], noise=84)["observation"]
    ]
    np.testing.assert_array_equal(small["observation"], means)
    assert_equal_rows(rows_of_set(tmp_path / "own"), small, but=["observation"])


@pytest.mark.parametrize("shortest", [1, 8])
def test_interrupted_import_resumes_to_identical_files(tmp_path, monkeypatch, shortest):
    folder = write_fake_set(tmp_path / "own", [7, 9, 8, 12, 5], attributes={"task": "walker_walk"})
    monkeypatch.setattr("vd4rl_pomdp.data.transfer._SHARD_ROWS", 20)
    whole = import_set("vd4rl", str(folder), tmp_path / "whole", shortest=shortest)
    kept = [number for number, length in enumerate([7, 9, 8, 12, 5]) if length >= shortest]
    assert (
        rows_of_set(tmp_path / "whole")["observation"][:, 0, 0, 0].tolist()
        == np.repeat(kept, [[7, 9, 8, 12, 5][number] for number in kept]).tolist()
    )
    written = []

    def write(path, rows, attributes):
        if written:
            raise KeyboardInterrupt
        written.append(path)
        write_shard(path, rows, attributes)

    with monkeypatch.context() as patch:
        patch.setattr("vd4rl_pomdp.data.shards.write_shard", write)
        with pytest.raises(KeyboardInterrupt):
            import_set("vd4rl", str(folder), tmp_path / "set", shortest=shortest)
    with pytest.raises(UserError, match="collection is not finished"):
        open_dataset(tmp_path / "set")
    changed = written[0].stat().st_mtime_ns
    shards = import_set("vd4rl", str(folder), tmp_path / "set", shortest=shortest)
    assert written[0].stat().st_mtime_ns == changed
    assert [shard.read_bytes() for shard in shards] == [shard.read_bytes() for shard in whole]
    monkeypatch.setattr("vd4rl_pomdp.data.transfer._SHARD_ROWS", 10)  # as if by another version
    with pytest.raises(UserError, match="differs in episodes_per_shard"):
        import_set("vd4rl", str(folder), tmp_path / "set", shortest=shortest)


def test_shards_of_large_frames_have_fewer_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("vd4rl_pomdp.data.transfer._SHARD_ROWS", 24)
    episodes = [fake_episode(number, 6) for number in range(4)]
    rows = {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}
    for size, shards in ((84, 1), (240, 4)):
        rows["observation"] = np.zeros((24, 3, size, size), np.uint8)
        own = write_rows(tmp_path / str(size), rows, {"task": "walker_walk"})
        assert len(import_set("vd4rl", str(own), tmp_path / f"set{size}")) == shards


def test_import_holds_two_shards_at_most(tmp_path, monkeypatch):
    monkeypatch.setattr("vd4rl_pomdp.data.transfer._SHARD_ROWS", 200)
    monkeypatch.setattr("vd4rl_pomdp.data.transfer.write_card", lambda out: None)  # it imports matplotlib
    episodes = [fake_episode(number % 8, 20) for number in range(40)]
    rows = {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}
    export_set("vd4rl_npz", write_rows(tmp_path / "own", rows), tmp_path / "npz")
    del rows, episodes
    tracemalloc.start()
    try:
        assert len(import_set("vd4rl_npz", str(tmp_path / "npz"), tmp_path / "set")) == 4
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2.5 * 200 * 3 * 84**2


def test_episodes_longer_than_row_keys_are_rejected(tmp_path, monkeypatch):
    own = write_fake_set(tmp_path / "own", [20, 25])
    export_set("vd4rl_npz", own, tmp_path / "npz")
    monkeypatch.setattr("vd4rl_pomdp.data.folder.MOST_ROWS", 24)
    with pytest.raises(UserError, match="own: an episode has 25 rows, more than 24"):
        open_dataset(own, tmp_path / "cache")
    with pytest.raises(UserError, match="npz: an episode has 25 rows, more than 24"):
        import_set("vd4rl_npz", str(tmp_path / "npz"), tmp_path / "set")
    assert not (tmp_path / "set").exists(), "refused before the import"


def test_minari_export_needs_space_for_its_images(minari, tmp_path, monkeypatch):
    folder, need = write_fake_set(tmp_path / "own", [4, 4]), 8 * 3 * 84**2
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("usage", (), {"free": need - 1}))
    with pytest.raises(UserError, match=r"a-v0: the export needs 169,344 bytes, the disk has 169,343; free some space"):
        export_set("minari", folder, tmp_path / "a-v0")
    assert not [path for path in tmp_path.iterdir() if "a-v0" in path.name]


def test_short_episodes_are_left_out(tmp_path, capsys):
    own = write_fake_set(tmp_path / "own", [20, 5, 25, 1], attributes={"task": "walker_walk"})
    with pytest.raises(UserError, match=r"holds no episodes of 26 or more rows"):
        import_set("vd4rl", str(own), tmp_path / "none", shortest=26)
    main(["data", "import", "vd4rl", str(own), str(tmp_path / "set"), "--shortest", "8"])
    stderr = capsys.readouterr().err
    assert "2 episodes of fewer than 8 rows are left out" in stderr
    assert "2 episodes are shorter than pretraining's default window of 32 rows" in stderr
    assert "pretrain with --window 20" in stderr
    rows = rows_of_set(own)
    assert_equal_rows(
        {key: np.concatenate([v[:20], v[25:50]]) for key, v in rows.items()}, rows_of_set(tmp_path / "set")
    )
    assert pretrain(smoke_pretrain(tmp_path / "set", tmp_path / "run")).finished


def test_interrupted_export_leaves_nothing(tmp_path, monkeypatch):
    folder, save, saved = write_fake_set(tmp_path / "own", LENGTHS), np.savez_compressed, []

    def cut(path, **rows):
        saved.append(path)
        if len(saved) == 2:
            raise KeyboardInterrupt
        save(path, **rows)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", cut)
        with pytest.raises(KeyboardInterrupt):
            export_set("vd4rl_npz", folder, tmp_path / "npz")
    assert not (tmp_path / "npz").exists()
    export_set("vd4rl_npz", folder, tmp_path / "npz")
    assert len(os.listdir(tmp_path / "npz")) == 3
    assert {name for name in os.listdir(tmp_path) if "npz" in name} == {"npz"}
    with pytest.raises(UserError, match="is not empty"):
        export_set("vd4rl_npz", folder, tmp_path / "npz")
    with pytest.raises(UserError, match="cannot be written: choose one of lerobot, lerobot_video, minari, vd4rl_npz"):
        export_set("ogbench", folder, tmp_path / "b")


def test_out_of_bounds_actions_are_rejected_or_clipped(tmp_path, capsys):
    rows = fake_episode(0, 5)
    rows["action"][2] = 1.5
    own = str(write_rows(tmp_path / "own", rows))
    with pytest.raises(UserError, match=r"episode 0: has actions outside .*\(up to 1.5 .*--clip-actions"):
        import_set("vd4rl", own, tmp_path / "set")
    import_set("vd4rl", own, tmp_path / "set", clip_actions=True)
    assert "1 actions lay outside their bounds and were clipped" in capsys.readouterr().err
    assert rows_of_set(tmp_path / "set")["action"].max() == 1


def test_minari_recording_through_autoreset_prints_a_note(minari, tmp_path, capsys):
    pytest.importorskip("jax")
    collector = minari.DataCollector(gymnasium.wrappers.Autoreset(Screen(steps=3)))
    collector.reset(seed=0)
    for _ in range(7):
        collector.step(collector.action_space.sample())
    collector.create_dataset("test/auto-v0")
    import_set("minari", "test/auto-v0", tmp_path / "set")
    assert "every episode begins with the last image of the one before" in capsys.readouterr().err


def test_set_without_task_trains_without_evaluation(tmp_path):
    source = str(write_fake_set(tmp_path / "own", LENGTHS))
    folder = import_set("vd4rl", source, tmp_path / "pushing", quality="x")[0].parent
    pretrain(smoke_pretrain(folder, tmp_path / "run"))
    assert "Imported from vd4rl: bytes" in (folder / "card.md").read_text()
    encoder, out = tmp_path / "run" / "encoder", tmp_path / "policy"
    with pytest.raises(UserError, match=r"unknown task 'own': choose one of .*; `--eval-episodes 0` trains a policy"):
        finetune(smoke_finetune(encoder, folder, out))
    run = finetune(smoke_finetune(encoder, folder, out, eval_episodes=0))
    assert run.finished
    assert read_episodes(out / "episodes.csv") == []
    assert policy_step(out / "policy") == 40
    shutil.move(folder, tmp_path / "sets" / "own" / "x")
    text = 'preset = "smoke"\ncollect = {task = "own", quality = "x"}\npretrain = {method = "mik+a", corruption = '
    (tmp_path / "g.toml").write_text(text + '"patch+zero_frames"}\nfinetune = {eval_episodes = 0}\n')
    cells = load_grid(str(tmp_path / "g.toml")).cells()
    jobs, _ = plan_jobs(cells, tmp_path, tmp_path / "sets")
    assert [job.finished for job in jobs] == [True] * 3, "the grid finds both runs"
    assert len(GridMembers("g.toml", cells).among(find_results([tmp_path]))) == 2, "so does its report"


def test_grid_accepts_imported_set(tmp_path):
    own = write_fake_set(tmp_path / "own", LENGTHS, attributes={"task": "walker_walk"})
    import_set("vd4rl", str(own), tmp_path / "set")
    DataSet("set", tmp_path / "set", "collect", {"task": "walker_walk"}).check()
