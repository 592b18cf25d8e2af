import h5py
import numpy as np
import pytest
import torch

from tests.helpers_data import fake_action, fake_reward, fake_rows, frame_identity, write_fake_set, write_rows
from vd4rl_pomdp.core.errors import OutOfMemoryError, UserError
from vd4rl_pomdp.core.types import row_key
from vd4rl_pomdp.data import TransitionSampler, View, WindowSampler, open_dataset
from vd4rl_pomdp.data.folder import shard_paths

LENGTHS = (5, 3, 260)
ROWS = [(e, t) for e, length in enumerate(LENGTHS) for t in range(length)]
STARTS = [(e, t) for e, t in ROWS if t + 1 < LENGTHS[e]]
"""(episode, t) of every transition, in order."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    base = tmp_path_factory.mktemp("dataset")
    folder = write_fake_set(base / "walker_walk" / "expert" / "84px", LENGTHS, cuts=(2, 6, 30), complete_last=False)
    return open_dataset(folder, cache=base / "cache")


def stack_identity(episode, t, frames=3):
    return [[episode, max(t - back, 0)] for back in reversed(range(frames))]


def test_dataset_counts_names_and_returns(dataset):
    assert (dataset.num_rows, dataset.num_episodes, dataset.num_transitions) == (268, 3, 265)
    assert (dataset.action_dim, dataset.incomplete_episodes) == (6, 1)
    assert (dataset.task, dataset.quality, dataset.physics) == ("walker_walk", "expert", None)
    assert dataset.episode_start.tolist() == [0, 5, 8]
    assert dataset.episode_end.tolist() == [5, 8, 268]
    assert list(zip(dataset.episode.tolist(), dataset.t.tolist(), strict=True)) == ROWS
    expected = [sum(fake_reward(e, t) for t in range(length - 1)) for e, length in enumerate(LENGTHS)]
    np.testing.assert_allclose(dataset.returns, expected, rtol=1e-12)


def test_out_of_memory_error_names_dataset_frames(dataset, monkeypatch):
    def full(self, device):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(torch.Tensor, "to", full)
    with pytest.raises(OutOfMemoryError, match=r"84px: 0.0 GB of frames exceed the free memory of cuda: choose"):
        dataset.to("cuda")


def test_transition_fields_are_aligned(dataset):
    batch = View(dataset).transitions(range(dataset.num_transitions))
    assert batch.obs.shape == batch.next_obs.shape == (265, 9, 84, 84)
    assert batch.obs.dtype == torch.uint8
    assert frame_identity(batch.obs).tolist() == [stack_identity(e, t) for e, t in STARTS]
    assert frame_identity(batch.next_obs).tolist() == [stack_identity(e, t + 1) for e, t in STARTS]
    np.testing.assert_array_equal(batch.action, np.stack([fake_action(e, t) for e, t in STARTS]))
    np.testing.assert_array_equal(batch.reward, np.float32([fake_reward(e, t) for e, t in STARTS]))
    assert batch.discount.tolist() == [1.0] * 265
    assert batch.key.tolist() == [(e << 20) + t for e, t in STARTS]
    assert batch.next_key.tolist() == [(e << 20) + t + 1 for e, t in STARTS]


@pytest.mark.parametrize("n", [2, 3, 10])
def test_n_step_returns_stop_at_episode_end(dataset, n):
    gamma = 0.5
    batch = View(dataset).transitions(range(dataset.num_transitions), n_step=n, gamma=gamma)
    taken = [min(n, LENGTHS[e] - 1 - t) for e, t in STARTS]
    rewards = [sum(gamma**i * fake_reward(e, t + i) for i in range(m)) for (e, t), m in zip(STARTS, taken, strict=True)]
    np.testing.assert_allclose(batch.reward, rewards, rtol=1e-6)
    np.testing.assert_allclose(batch.discount, [gamma ** (m - 1) for m in taken], rtol=1e-6)
    ends = [(e, t + m) for (e, t), m in zip(STARTS, taken, strict=True)]
    assert frame_identity(batch.next_obs).tolist() == [stack_identity(e, t) for e, t in ends]
    assert batch.next_key.tolist() == [(e << 20) + t for e, t in ends]
    np.testing.assert_array_equal(batch.action, np.stack([fake_action(e, t) for e, t in STARTS]))
    there = [fake_action(e, t) * (t < LENGTHS[e] - 1) for e, t in ends]
    np.testing.assert_array_equal(batch.next_action, np.stack(there))


def test_stored_discounts_multiply_n_step_returns(tmp_path):
    rows = fake_rows((5,)) | {"discount": np.array([9.0, 0.5, 0.25, 1.0, 0.0])}
    view = View(open_dataset(write_rows(tmp_path / "set", rows), tmp_path / "cache"))
    np.testing.assert_allclose(view.transitions(range(4)).discount, [0.5, 0.25, 1.0, 0.0])
    batch = view.transitions(range(4), n_step=2, gamma=0.1)
    np.testing.assert_allclose(batch.discount, [0.0125, 0.025, 0.0, 0.0])
    np.testing.assert_allclose(batch.reward, [0.00005, 0.00105, 0.0023, 0.003], rtol=1e-5)


def test_reward_of_first_row_is_ignored(tmp_path):
    found = []
    for stored in (0.0, 100.0):
        rows = fake_rows((5, 3))
        rows["reward"][[0, 5]] = stored
        dataset = open_dataset(write_rows(tmp_path / str(stored), rows), tmp_path / "cache")
        found.append((dataset.returns.tolist(), View(dataset).transitions(range(6), n_step=3).reward.tolist()))
    assert found[0] == found[1]


def test_last_row_has_zero_return(dataset):
    reward, discount, successor = dataset.n_step_returns(torch.tensor([4, 3]), n_step=3, gamma=0.9)
    assert reward.tolist() == [0.0, pytest.approx(0.003)]
    assert discount.tolist() == [1.0, 1.0]
    assert successor.tolist() == [4, 4]


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_frame_stacks_repeat_first_frame(dataset, frames):
    rows = torch.tensor([[0, 1, 5], [6, 8, 267]])
    stacks = View(dataset, frame_stack=frames).stacks(rows)
    assert stacks.shape == (2, 3, 3 * frames, 84, 84)
    expected = [[stack_identity(*ROWS[row], frames) for row in line] for line in rows.tolist()]
    assert frame_identity(stacks).tolist() == expected


def test_window_fields_are_aligned(dataset):
    length = 3
    starts = [(e, t) for e, t in ROWS if t + length <= LENGTHS[e]]
    assert dataset.num_windows(length) == len(starts) == 3 + 1 + 258
    batch = View(dataset).windows(np.arange(len(starts)), length)
    assert batch.obs.shape == (len(starts), 3, 9, 84, 84)
    assert frame_identity(batch.obs).tolist() == [[stack_identity(e, t + j) for j in range(3)] for e, t in starts]
    zero = np.zeros(6, np.float32)
    for i, (e, t) in enumerate(starts):
        following = [t + j + 1 < LENGTHS[e] for j in range(3)]
        assert batch.has_action[i].tolist() == following
        actions = [fake_action(e, t + j) if there else zero for j, there in enumerate(following)]
        np.testing.assert_array_equal(batch.action[i], actions)
        np.testing.assert_array_equal(batch.prev_action[i], [zero, fake_action(e, t), fake_action(e, t + 1)])
        assert batch.key[i].tolist() == [(e << 20) + t + j for j in range(3)]
    assert batch.length.tolist() == [3] * len(starts)
    assert (batch.length.dtype, batch.has_action.dtype, batch.key.dtype) == (torch.int64, torch.bool, torch.int64)


def test_window_longer_than_an_episode_is_rejected(dataset):
    message = (
        r"episode 0 has 5 rows, fewer than the window of 6 \(2 such episodes\); choose a window of at most 3, or .*"
    )
    message += "--shortest 6`"
    for call in (dataset.num_windows, lambda length: View(dataset).windows([0], length)):
        with pytest.raises(UserError, match=message):
            call(6)


def test_windows_skip_episodes_of_one_row(tmp_path):
    dataset = open_dataset(write_fake_set(tmp_path / "set", (1, 5, 1, 4, 1)), tmp_path / "cache")
    assert (dataset.num_windows(2), dataset.num_windows(4)) == (dataset.num_transitions, 3) == (7, 3)
    starts = View(dataset).windows([0, 1, 2], 4).key[:, 0]
    assert starts.tolist() == [row_key(torch.tensor(e), torch.tensor(t)).item() for e, t in [(1, 0), (1, 1), (3, 0)]]
    with pytest.raises(UserError, match=r"episode 1 has 5 rows, .* \(2 such episodes\); choose a window of at most 4"):
        dataset.num_windows(6)
    empty = open_dataset(write_fake_set(tmp_path / "empty", (1, 1)), tmp_path / "cache")
    with pytest.raises(UserError, match="holds no transitions, since every episode has a single row"):
        empty.num_windows(2)


ARRAYS = [np.array([7]), np.array([7], np.uint64), np.arange(7, 8)[::-1], np.broadcast_to(np.int64(7), (1,))]


@pytest.mark.parametrize("index", [7, [7], (7,), np.int64(7), torch.tensor(7), torch.tensor([7]), *ARRAYS])
@pytest.mark.filterwarnings("error")
def test_integer_indices_of_any_type_are_accepted(dataset, index):
    assert View(dataset).transitions(index).key.tolist() == [row_key(torch.tensor(2), torch.tensor(1)).item()]
    assert View(dataset).windows(index, 2).key[:, 0].tolist() == View(dataset).transitions(index).key.tolist()


@pytest.mark.parametrize("index", [-1, 265, [0, 265], [[0]], 1.0, [True]])
def test_invalid_indices_are_rejected(dataset, index):
    with pytest.raises(IndexError):
        View(dataset).transitions(index)
    with pytest.raises(IndexError):
        View(dataset).windows(index, 2)


def test_negative_rows_and_counts_below_one_are_rejected(dataset):
    with pytest.raises(IndexError, match="row -1 is out of range"):
        View(dataset).stacks(torch.tensor([0, -1]))
    with pytest.raises(UserError, match="--n-step is 0"):
        View(dataset).transitions(0, n_step=0)
    for gamma in (99, float("nan")):
        with pytest.raises(UserError, match=f"--gamma is {gamma}"):
            View(dataset).transitions(0, gamma=gamma)
        with pytest.raises(UserError, match=f"--gamma is {gamma}"):
            TransitionSampler(dataset, 1, torch.Generator(), gamma=gamma)
    with pytest.raises(UserError, match="--frame-stack is 0"):
        View(dataset, frame_stack=0)
    with pytest.raises(UserError, match="--shift is -4"):
        View(dataset, shift=-4)


def test_gathered_frames_are_copies(dataset):
    View(dataset, frame_stack=1).stacks(torch.tensor([0])).fill_(255)
    assert dataset.frames[0].max() == 0


def test_names_come_from_attributes_then_folders(tmp_path):
    def names(folder, **attributes):
        dataset = open_dataset(write_fake_set(tmp_path / folder, attributes=attributes), tmp_path / "cache")
        return dataset.task, dataset.quality

    assert names("cheetah_run/random", task="walker_walk", set="medium") == ("walker_walk", "medium")
    assert names("elsewhere") == (None, None)
    assert names("expert/walker_walk/humanA") == ("walker_walk", "humanA"), "any folder below the task's"
    folder = write_fake_set(tmp_path / "cheetah_run/random", names=["1_fake.hdf5"], attributes={"task": "cheetah_run"})
    with pytest.raises(UserError, match="its shards come from cheetah_run and walker_walk"):
        open_dataset(folder, tmp_path / "cache")


SAMPLERS = {
    "transitions": lambda view, draws: TransitionSampler(view, 64, draws, n_step=2),
    "windows": lambda view, draws: WindowSampler(view, 64, 2, draws),
}


@pytest.mark.parametrize("kind", SAMPLERS)
def test_samplers_are_seeded_and_cover_all_rows(dataset, kind):
    def keys(seed):
        sampler = iter(SAMPLERS[kind](View(dataset, frame_stack=1), torch.Generator().manual_seed(seed)))
        return torch.cat([next(sampler).key for _ in range(30)])

    assert torch.equal(keys(0), keys(0))
    assert not torch.equal(keys(0), keys(1))
    assert set(keys(0).view(30 * 64, -1)[:, 0].tolist()) == {(e << 20) + t for e, t in STARTS}


@pytest.mark.gpu
@pytest.mark.parametrize("kind", SAMPLERS)
def test_cuda_batches_equal_cpu_batches(tmp_path, kind):
    folder = write_fake_set(tmp_path / "set", (9, 5))
    here, there = (
        SAMPLERS[kind](
            View(open_dataset(folder, tmp_path / "cache").to(device)), torch.Generator().manual_seed(0)
        ).sample()
        for device in ("cpu", "cuda")
    )
    assert there.obs.is_cuda
    for name in here.keys():  # noqa: SIM118
        torch.testing.assert_close(there[name].cpu(), here[name])


def test_quirks_of_published_files_are_read_correctly(tmp_path):
    """Shards cut within episodes, float step_type, `10_` after `9_`, two halves in one folder, no final row."""
    folder = tmp_path / "humanoid_walk" / "medium_expert"
    lengths = (9, 4, 9, 2)
    cuts = (1, 2, 3, 5, 6, 8, 9, 11, 12, 13, 22)  # the medium half begins with episode 3
    names = [f"{i}_walker_expert.hdf5" for i in range(11)] + ["0_walker_medium.hdf5"]
    write_fake_set(folder, lengths, 21, complete_last=False, cuts=cuts, names=names)
    for path in shard_paths(folder)[::2]:
        with h5py.File(path, "a") as file:
            step_type = file["step_type"][()].astype(np.float64)
            del file["step_type"]
            file["step_type"] = step_type
    dataset = open_dataset(folder, tmp_path / "cache")
    assert (dataset.num_rows, dataset.num_episodes, dataset.incomplete_episodes) == (24, 4, 1)
    assert (dataset.task, dataset.quality, dataset.action_dim) == ("humanoid_walk", "medium_expert", 21)
    expected = [(e, t) for e, length in enumerate(lengths) for t in range(length)]
    assert [tuple(pair) for pair in frame_identity(dataset.frames)[:, 0].tolist()] == expected
    starts = [(e, t) for e, t in expected if t + 1 < lengths[e]]
    batch = View(dataset).transitions(range(dataset.num_transitions))
    np.testing.assert_array_equal(batch.action, np.stack([fake_action(e, t, 21) for e, t in starts]))


def test_symlink_names_determine_task_and_quality(tmp_path):
    held = write_fake_set(tmp_path / "held" / "medium", physics_dim=18)
    (tmp_path / "walker_walk").mkdir()
    (tmp_path / "walker_walk" / "expert").symlink_to(held)
    linked = open_dataset(tmp_path / "walker_walk" / "expert", tmp_path / "cache")
    assert (linked.task, linked.quality) == ("walker_walk", "expert")
    with pytest.raises(UserError, match=r"medium: has physics but no task name; put it in a folder named"):
        open_dataset(held, tmp_path / "cache").require_states()
