import errno
import multiprocessing
import os
import signal
import time

import h5py
import numpy as np
import pytest

from tests.helpers_data import fake_rows, frame_identity, write_fake_set, write_rows
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import store as store_module
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.data.store import default_cache, open_store, verify_store
from vd4rl_pomdp.runs.files import write_json

fork = multiprocessing.get_context("fork")


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


def slow_frames(log, seconds):
    """`read_frames` that logs every call and sleeps after every block."""

    def read(path, original=store_module.read_frames):
        with log.open("a") as file:
            file.write(f"{path.name}\n")
        for block in original(path):
            yield block
            time.sleep(seconds)

    return read


def visible(cache):
    return sorted(p.name for p in cache.iterdir() if p.suffix != ".lock")


def test_decoded_arrays_concatenate_shards(tmp_path, cache):
    rows = fake_rows((5, 4, 6), physics_dim=3)
    store = open_store(write_fake_set(tmp_path / "set", (5, 4, 6), physics_dim=3, cuts=(3, 11)), cache)
    np.testing.assert_array_equal(store.frames(), rows["observation"])
    for key in ("action", "reward", "discount", "step_type"):
        np.testing.assert_array_equal(store.array(key), rows[key])
    np.testing.assert_array_equal(store.physics(), rows["physics"])
    assert not store.frames().flags.writeable
    assert store.meta["shards"] == ["0_fake.hdf5", "1_fake.hdf5", "2_fake.hdf5"]


def test_changed_set_is_decoded_again(tmp_path, cache):
    folder = write_fake_set(tmp_path / "set", (4,))
    before = open_store(folder, cache)
    write_shard(folder / "1_fake.hdf5", fake_rows((3,)), {})
    after = open_store(folder, cache)
    assert (before.meta["rows"], after.meta["rows"]) == (4, 7)
    assert before.fingerprint != after.fingerprint


def test_rewritten_shard_of_equal_size_is_decoded_again(tmp_path, cache):
    found = []
    for discount in (1.0, 0.5):
        folder = write_rows(tmp_path / "set", fake_rows((4,)) | {"discount": np.full(4, discount)})
        os.truncate(folder / "0_fake.hdf5", 99_999)  # HDF5 ignores the zeros at its end
        found.append(open_store(folder, cache).array("discount")[-1])
    assert found == [1, 0.5]


def test_fingerprint_hashes_content_and_rewards_as_float32(tmp_path, cache):
    """The last float64 bit of a reward may differ between processors."""

    def fingerprint(reward, **changes):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        write_shard(folder / "0_fake.hdf5", rows | {"reward": reward} | changes, {})
        return open_store(folder, cache).fingerprint

    rows = fake_rows((5, 4))
    reward = rows["reward"] / 3
    assert fingerprint(reward) == fingerprint(np.nextafter(reward, np.inf))
    assert fingerprint(np.nextafter(reward.astype(np.float32), np.inf, dtype=np.float32)) != fingerprint(reward)
    changed = {key: rows[key].copy() for key in ("observation", "action", "discount")}
    for values in changed.values():
        values[-1] = 0
    rows["physics"] = np.zeros((9, 2))
    changed |= {"physics": rows["physics"] + 1, "step_type": np.append(rows["step_type"][:-1], 1)}
    assert len({fingerprint(reward), *(fingerprint(reward, **{key: changed[key]}) for key in changed)}) == 6


def test_cache_folder_follows_environment_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("VD4RL_POMDP_CACHE", raising=False)
    assert default_cache() == tmp_path / "xdg" / "vd4rl-pomdp"
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path / "own"))
    assert default_cache() == tmp_path / "own"


@pytest.mark.parametrize("name", ["frames.u8", "reward.npy"])
def test_store_detects_flipped_byte_and_short_file(tmp_path, cache, name):
    folder = write_fake_set(tmp_path / "set")
    store = open_store(folder, cache)
    verify_store(store)
    content = bytearray((store.folder / name).read_bytes())
    content[-1] ^= 1
    (store.folder / name).write_bytes(content)
    with pytest.raises(UserError, match=rf"{name}: is damaged; delete"):
        verify_store(store)
    (store.folder / name).write_bytes(content[:-1])
    verify_store(open_store(folder, cache))  # decodes again


def test_concurrent_processes_decode_once(tmp_path, cache, monkeypatch):
    folder = write_fake_set(tmp_path / "set", (5, 4), cuts=(3,))
    log = tmp_path / "log"
    monkeypatch.setattr(store_module, "read_frames", slow_frames(log, 0.2))
    with fork.Pool(2) as pool:
        stores = pool.starmap(open_store, [(folder, cache)] * 2, chunksize=1)
    assert stores[0] == stores[1]
    assert log.read_text() == "0_fake.hdf5\n1_fake.hdf5\n"
    np.testing.assert_array_equal(stores[0].frames(), fake_rows((5, 4))["observation"])
    assert visible(cache) == [stores[0].folder.name]


def test_killed_decode_is_repeated(tmp_path, cache, monkeypatch):
    folder = write_fake_set(tmp_path / "set", (5, 4), cuts=(3,))
    log = tmp_path / "log"
    with monkeypatch.context() as patch:
        patch.setattr(store_module, "read_frames", slow_frames(log, 60))
        process = fork.Process(target=open_store, args=(folder, cache))
        process.start()
    while not log.exists():
        time.sleep(0.01)
    assert process.pid
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert [name[0] for name in visible(cache)] == ["."], "only a hidden folder may exist"
    store = open_store(folder, cache)
    verify_store(store)
    assert visible(cache) == [store.folder.name]


@pytest.mark.parametrize("stage", ["_write_frames", "_checksum"])
def test_full_disk_leaves_empty_cache(tmp_path, cache, monkeypatch, stage):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store_module, stage, full)
    with pytest.raises(UserError, match=r"cache: the disk is full: free some space"):
        open_store(write_fake_set(tmp_path / "set"), cache)
    assert visible(cache) == []


def test_insufficient_space_is_reported_before_decoding(tmp_path, cache, monkeypatch):
    monkeypatch.setattr(store_module.shutil, "disk_usage", lambda _: type("usage", (), {"free": 8 * 21168 - 1}))
    with pytest.raises(UserError, match=r"decoding needs 169,344 bytes, the disk has 169,343; .*VD4RL_POMDP_CACHE"):
        open_store(write_fake_set(tmp_path / "set", (4, 4)), cache)
    assert visible(cache) == []


def test_rows_outside_episodes_are_rejected(tmp_path, cache):
    folder = write_fake_set(tmp_path / "set", (4, 4, 4), cuts=(6,))
    with h5py.File(folder / "1_fake.hdf5", "a") as file:
        file["step_type"][2] = 1  # row 8, the third episode's first
    with pytest.raises(UserError, match=r"1_fake\.hdf5: row 2 follows an episode's last row without beginning"):
        open_store(folder, cache)
    (folder / "1_fake.hdf5").replace(folder / "0_fake.hdf5")
    with pytest.raises(UserError, match=r"0_fake\.hdf5: row 0 has step_type 1, but the first row .*missing"):
        open_store(folder, cache)
    folder = write_fake_set(tmp_path / "groups", (4, 4), cuts=(2,), names=["0_a.hdf5", "0_b.hdf5"])
    with pytest.raises(UserError, match=r"0_b\.hdf5: row 0 is the first of its shards, but begins no episode"):
        open_store(folder, cache)
    assert visible(cache) == []


def test_leading_shards_or_single_shard_are_opened(tmp_path, cache):
    folder = write_fake_set(tmp_path / "set", (3, 3, 3), cuts=(3, 6))
    (folder / "2_fake.hdf5").unlink()
    for path, episodes in ((folder, (0, 1)), (folder / "1_fake.hdf5", (1,))):
        rows = frame_identity(open_store(path, cache).frames())[:, 0].tolist()
        assert rows == [[episode, t] for episode in episodes for t in range(3)]


@pytest.mark.parametrize("unit", ["episodes", "trajectories"])
def test_collected_set_with_missing_episodes_is_rejected(tmp_path, cache, unit):
    folder = write_fake_set(tmp_path / "set", (3, 3, 3), cuts=(3, 6))
    write_json(folder / "collection.json", {unit: 3})
    write_json(folder / "provenance.json", {})
    assert open_store(folder, cache).meta["rows"] == 9
    (folder / "2_fake.hdf5").unlink()
    with pytest.raises(UserError, match=r"set: holds 2 episodes, its collection\.json says 3: is a shard missing"):
        open_store(folder, cache)
    assert open_store(folder / "1_fake.hdf5", cache).meta["rows"] == 3, "a single shard may be opened"
    assert open_store(folder / "0_fake.hdf5", cache).meta["rows"] == 3
    (folder / "1_fake.hdf5").unlink()
    with pytest.raises(UserError, match="holds 1 episodes"):
        open_store(folder, cache)


@pytest.mark.parametrize(
    ("second", "key"),
    [({"action_dim": 5, "physics_dim": 3}, "action"), ({"physics_dim": 4}, "physics"), ({}, "physics")],
)
def test_shards_of_different_sets_are_rejected(tmp_path, cache, second, key):
    write_fake_set(tmp_path / "set", (4,), physics_dim=3, names=["0_a.hdf5"])
    write_fake_set(tmp_path / "set", (4,), names=["0_b.hdf5"], **second)
    with pytest.raises(UserError, match=rf"0_b\.hdf5: '{key}' has other dimensions than in 0_a\.hdf5"):
        open_store(tmp_path / "set", cache)


@pytest.mark.parametrize("size", [16, 480])
def test_frame_size_is_read_from_shards(tmp_path, cache, size):
    write_fake_set(tmp_path / "set", [6], noise=size)
    for _ in range(2):
        frames = open_store(tmp_path / "set", cache).frames()
        np.testing.assert_array_equal(frames, fake_rows([6], noise=size)["observation"])
    write_fake_set(tmp_path / "set", [6], names=["1_fake.hdf5"])
    with pytest.raises(UserError, match=rf"1_fake.hdf5: has frames of 84x84 pixels, 0_fake.hdf5 of {size}x{size}"):
        open_store(tmp_path / "set", cache)


@pytest.mark.parametrize("size", [15, 481])
def test_unsupported_frame_sizes_are_rejected(tmp_path, cache, size):
    write_fake_set(tmp_path / "set", [6], noise=size)
    with pytest.raises(UserError, match=r"square uint8 frames \(N, 3, S, S\) of 16 to 480 pixels"):
        open_store(tmp_path / "set", cache)
