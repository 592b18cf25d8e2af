import errno
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.helpers_data import fake_rows, read_shard, write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.folder import shard_paths
from vd4rl_pomdp.data.format import read_attributes, read_frame_size, read_frames, write_shard


@pytest.fixture
def shard(tmp_path):
    return write_fake_set(tmp_path / "set", (4, 3)) / "0_fake.hdf5"


def alter(path, key, change):
    """Replace one key of a shard by change(its array), dtype and all."""
    with h5py.File(path, "a") as file:
        value = change(file[key][()])
        del file[key]
        if value is not None:
            file[key] = value


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([f"{number}_mixed" for number in reversed(range(11))], [f"{number}_mixed" for number in range(11)]),
        (
            ["0_walker_walk_expert", "0_walker_walk_medium", "1_walker_walk_expert", "1_walker_walk_medium"],
            ["0_walker_walk_expert", "1_walker_walk_expert", "0_walker_walk_medium", "1_walker_walk_medium"],
        ),
        (["shard_10_reward_4", "shard_2_reward_30"], ["shard_2_reward_30", "shard_10_reward_4"]),
    ],
)
def test_shards_are_sorted_by_name_then_number(tmp_path, names, expected):
    for name in names:
        (tmp_path / f"{name}.hdf5").touch()
    assert [p.stem for p in shard_paths(tmp_path)] == expected


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["0_a.hdf5", "1_a.hdf5", "3_a.hdf5"], "0_a.hdf5, 1_a.hdf5, 3_a.hdf5"),
        (["0_a.hdf5", "1_a.hdf5", "1_b.hdf5", "2_b.hdf5"], "1_b.hdf5, 2_b.hdf5"),
        (["0.hdf5", "2.hdf5"], "0.hdf5, 2.hdf5"),
        (["0_a.hdf5", "0_a.h5"], "0_a.h.*, 0_a.h.*"),
        (["0_a.hdf5", "00_a.hdf5"], "00?_a.hdf5, 00?_a.hdf5"),
        (["a.HDF5", "a.hdf5"], "a.(HDF5|hdf5), a.(HDF5|hdf5)"),
    ],
)
def test_missing_and_repeated_shard_numbers_are_rejected(tmp_path, names, message):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=f": {message} are not numbered 0, 1, 2, ...; download or collect"):
        shard_paths(tmp_path)


def test_hidden_and_foreign_files_are_no_shards(tmp_path):
    for name in (".0_a.hdf5.tmp", ".0_b.hdf5", "0_a.txt", "0_a.hdf5", "collection.json", "provenance.json"):
        (tmp_path / name).touch()
    assert [p.name for p in shard_paths(tmp_path)] == ["0_a.hdf5"]


def test_missing_and_empty_folders_are_rejected(tmp_path):
    with pytest.raises(UserError, match=r"nothing: no such folder"):
        shard_paths(tmp_path / "nothing")
    with pytest.raises(UserError, match=r"holds no \.hdf5 shards; collect"):
        shard_paths(tmp_path)
    write_fake_set(tmp_path / "expert" / "84px")
    with pytest.raises(UserError, match=r"holds no \.hdf5 shards; name a folder of shards such as .*84px"):
        shard_paths(tmp_path)


def test_written_shard_has_published_layout(tmp_path):
    rows = fake_rows((4, 3), action_dim=2, physics_dim=5)
    write_shard(
        tmp_path / "0_a.hdf5", rows | {"step_type": rows["step_type"].astype(np.uint8)}, {"task": "x", "seed": 3}
    )
    with h5py.File(tmp_path / "0_a.hdf5") as file:
        layout = {key: (str(file[key].dtype), file[key].shape, file[key].compression) for key in file}
    assert layout == {
        "observation": ("uint8", (7, 3, 84, 84), "gzip"),
        "action": ("float32", (7, 2), "gzip"),
        "reward": ("float64", (7,), "gzip"),
        "discount": ("float64", (7,), "gzip"),
        "step_type": ("int64", (7,), "gzip"),
        "physics": ("float64", (7, 5), "gzip"),
    }
    assert read_attributes(tmp_path / "0_a.hdf5") == {"task": "x", "seed": 3}
    back = read_shard(tmp_path / "0_a.hdf5")
    assert back.keys() == rows.keys()
    for key in rows:
        np.testing.assert_array_equal(back[key], rows[key])


def test_float_frames_are_rejected(tmp_path):
    """As of pictures from 0 to 1, of which nothing but black would be left."""
    rows = fake_rows([4])
    with pytest.raises(UserError, match="observation is float64; frames must be uint8, from 0 to 255"):
        write_shard(tmp_path / "0_mine.hdf5", rows | {"observation": rows["observation"] / 255}, {})
    assert not list(tmp_path.iterdir())


def test_equal_rows_write_equal_bytes(tmp_path):
    for name in ("a.hdf5", "b.hdf5"):
        write_shard(tmp_path / name, fake_rows((3,)), {"seed": 1, "task": "x"})
    assert (tmp_path / "a.hdf5").read_bytes() == (tmp_path / "b.hdf5").read_bytes()


@pytest.mark.parametrize("chunks", [(7, 1, 84, 84), (3000, 3, 84, 84)])
def test_frames_are_read_in_order_for_any_chunking(tmp_path, chunks):
    frames = np.zeros((3000, 3, 84, 84), np.uint8)
    frames[:, 0, 0, 0], frames[:, 0, 0, 1] = np.arange(3000) // 256, np.arange(3000) % 256
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("observation", data=frames, chunks=chunks)
    blocks = list(read_frames(tmp_path / "a.hdf5"))
    assert max(len(block) for block in blocks) <= (3000 if chunks == (3000, 3, 84, 84) else 1024)
    np.testing.assert_array_equal(np.concatenate(blocks), frames)


def test_full_disk_keeps_old_shard(shard, monkeypatch):
    before = shard.read_bytes()

    def full(path, data):
        with path.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match=r"0_fake\.hdf5: the disk is full: free some space"):
        write_shard(shard, fake_rows((9,)), {})
    assert shard.read_bytes() == before
    assert [p.name for p in shard.parent.iterdir()] == [shard.name]


def with_value(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("reward", lambda v: None, r"has no 'reward'"),
        ("observation", lambda v: None, r"has no 'observation'"),
        ("action", with_value((2, 1), np.nan), r"'action' is not finite as float32 in row 2 \(1 such rows\)"),
        ("reward", with_value(slice(3, 5), np.inf), r"'reward' is not finite as float32 in row 3 \(2 such rows\)"),
        ("discount", with_value(0, np.nan), r"'discount' is not finite as float32 in row 0"),
        ("discount", with_value(3, 5.0), r"'discount' is 5\.0 in row 3, not within 0 and 1"),
        ("discount", with_value(2, -0.5), r"'discount' is -0\.5 in row 2, not within 0 and 1"),
        ("action", lambda v: with_value((2, 1), 1e300)(v.astype(float)), r"'action' is not finite as float32 in row 2"),
        ("reward", with_value(4, -1e300), r"'reward' is not finite as float32 in row 4"),
        ("action", lambda v: v.astype(int), r"'action' is int64"),
        ("action", lambda v: v[:, 0], r"'action' has shape \(7,\)"),
        ("reward", lambda v: v[:-1], r"'reward' has shape \(6,\), expected \(7,\)"),
        ("reward", lambda v: v[:, None], r"'reward' has shape \(7, 1\)"),
        ("step_type", lambda v: v + 1, r"'step_type' holds values other"),
        ("step_type", lambda v: v + 0.5, r"'step_type' holds values other"),
        ("observation", lambda v: v.astype(np.float32), r"'observation' is float32"),
        ("observation", lambda v: v[:, :, :64], r"'observation' is uint8 of shape \(7, 3, 64, 84\)"),
        ("observation", lambda v: v[:0], r"'observation' is uint8 of shape \(0, "),
    ],
)
def test_invalid_arrays_are_named(shard, key, change, message):
    alter(shard, key, change)
    with pytest.raises(UserError, match=message) as caught:
        read_shard(shard)
    assert str(shard) in str(caught.value)


def test_truncated_and_foreign_files_are_rejected(shard):
    whole = shard.read_bytes()
    for content in (whole[: len(whole) // 2], b"no HDF5 at all" * 100, b""):
        shard.write_bytes(content)
        with pytest.raises(UserError, match=r"0_fake\.hdf5: is truncated, damaged or not an HDF5"):
            read_shard(shard)


def test_damaged_pixels_are_rejected(tmp_path):
    write_fake_set(tmp_path, (300,))
    path = tmp_path / "0_fake.hdf5"
    with h5py.File(path) as file:
        chunk = file["observation"].id.get_chunk_info(2)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"0_fake\.hdf5: is truncated, damaged"):
        read_shard(path)


@pytest.mark.parametrize("key", ["observation", "reward", "physics"])
def test_null_dataset_counts_as_missing(shard, key):
    with h5py.File(shard, "a") as file:
        file.pop(key, None)
        file.create_dataset(key, data=h5py.Empty("f8"))
    with pytest.raises(UserError, match=f"has no '{key}'"):
        read_shard(shard)


@pytest.mark.parametrize("stored", ["[1]", "{", 5, '{"task": ' + "[" * 100_000])
def test_attributes_other_than_json_object_are_rejected(shard, stored):
    with h5py.File(shard, "a") as file:
        file.attrs["vd4rl_pomdp"] = stored
    with pytest.raises(UserError, match=r"0_fake\.hdf5: "):
        read_attributes(shard)


@pytest.mark.parametrize("kind", ["link", "links", "storage", "virtual"])
def test_arrays_in_other_files_are_rejected(shard, tmp_path, kind):
    with h5py.File(shard, "a") as file, h5py.File(tmp_path / "other.h5", "w") as other:
        value = file.pop("reward")[()]
        other["reward"] = value
        if kind == "link":
            file["reward"] = h5py.ExternalLink(other.filename, "reward")
        elif kind == "links":
            file["far"], file["reward"] = h5py.ExternalLink(other.filename, "reward"), h5py.SoftLink("/far")
        elif kind == "storage":
            value.tofile(tmp_path / "other.bin")
            file.create_dataset(
                "reward", value.shape, value.dtype, external=[(tmp_path / "other.bin", 0, value.nbytes)]
            )
        else:
            layout = h5py.VirtualLayout(value.shape, value.dtype)
            layout[...] = h5py.VirtualSource(other["reward"])
            file.create_virtual_dataset("reward", layout)
    with pytest.raises(UserError, match=r"'(far|reward)' is stored in another file"):
        read_shard(shard)


def test_files_that_links_name_are_not_opened(shard, tmp_path):
    os.mkfifo(tmp_path / "pipe")  # to open it would wait forever
    with h5py.File(shard, "a") as file:
        del file["reward"]
        file["reward"] = h5py.ExternalLink(str(tmp_path / "pipe"), "reward")
    with pytest.raises(UserError, match="'reward' is stored in another file"):
        read_shard(shard)


@pytest.mark.parametrize("key", ["observation", "reward"])
def test_unwritten_arrays_are_rejected_before_memory_is_taken(shard, key):
    with h5py.File(shard, "a") as file:
        shape, dtype = file[key].shape[1:], file[key].dtype
        del file[key]
        file.create_dataset(key, (10**10, *shape), dtype, chunks=(50, *shape), compression="gzip")
    with pytest.raises(UserError, match=rf"'{key}' has [\d,]+ bytes, of which 0 are stored"):
        read_shard(shard)


def test_constant_rows_are_not_taken_for_unwritten_ones(shard):
    with h5py.File(shard, "a") as file:
        del file["reward"]
        zeros, options = np.zeros(10**7), {"compression": "gzip", "compression_opts": 9}
        file.create_dataset("reward", data=zeros, chunks=(10**6,), **options)
        assert file["reward"].id.get_storage_size() * 1000 < zeros.nbytes
    assert read_frame_size([shard]) == 84
