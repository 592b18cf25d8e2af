"""Files that cannot be opened temporarily are reported as such, and not as damaged, by every reader."""

import errno
import fcntl
import os
import pydoc
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from shutil import copyfile

import h5py
import numpy as np
import pytest
from PIL import Image

from tests.helpers_data import write_fake_set
from tests.nn.test_encoder import CARD, make
from tests.studies.navigation.test_pictures import python_batch
from vd4rl_pomdp.cli import run_to_end
from vd4rl_pomdp.core.errors import TEMPORARY, UnavailableError, UserError, system_error
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.format import read_attributes, read_frame_size, read_frames, read_rows
from vd4rl_pomdp.data.store import verify_store
from vd4rl_pomdp.nn import load_encoder, save_encoder
from vd4rl_pomdp.nn.policy import Policy, load_policy, policy_step
from vd4rl_pomdp.policies.actor import ASSETS, read_actor, read_ladder
from vd4rl_pomdp.report.films import FILM, read_film
from vd4rl_pomdp.runs import FILM_FILE
from vd4rl_pomdp.runs.checkpoint import Checkpoints
from vd4rl_pomdp.runs.episodes import COLUMNS, episodes_until, read_episodes
from vd4rl_pomdp.runs.outputs import kept_in
from vd4rl_pomdp.runs.results import RUNS, read_results
from vd4rl_pomdp.studies.navigation.pictures import _read_cifar, _read_image, load_pool, source_fingerprint
from vd4rl_pomdp.studies.navigation.runs import read_trajectory
from vd4rl_pomdp.sweeps.folder import read_plan

ADVICE = ("damaged", "truncated", "delete", "download", "collect", "remove", "train", "replace", "another copy")
"""Words that must not be used for an undamaged file."""


@contextmanager
def no_more_files() -> Iterator[None]:
    """Set the limit of open files to those already open."""
    lowest = os.open("/dev/null", os.O_RDONLY)
    os.close(lowest)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.fixture
def world(tmp_path) -> dict[str, Callable[[], object]]:
    """Readers of all kinds of files, with valid files."""
    data = write_fake_set(tmp_path / "walker_walk" / "expert", (20, 25))
    shard, cache = min(data.glob("*.hdf5")), tmp_path / "cache"
    store = open_dataset(data, cache).store
    encoder, policy, run = (tmp_path / name for name in ("encoder", "policy", "run"))
    save_encoder(encoder, make("gru", True), CARD, frames=160)
    Policy(4, 2, 8).save(policy, step=7)
    run.mkdir()
    Checkpoints(run).add(1, {"a": 1}, 0.5)
    actor, ladder = (tmp_path / f"{name}.safetensors" for name in ("actor", "ladder"))
    copyfile(ASSETS / "walker_walk_expert.safetensors", actor)
    copyfile(ASSETS / "walker_walk_replay.safetensors", ladder)
    with (run / FILM_FILE).open("wb") as file:
        np.savez(file, **dict(zip(FILM, map(np.zeros, ((1, 3, 4, 4), (1, 9, 4, 4), 1)), strict=True)))
    (run / "episodes.csv").write_text(",".join(COLUMNS) + "\n")
    (run / "trajectory.csv").write_text("x,y,estimated_x,estimated_y\n0,0,0,0\n")
    (run / RUNS).write_text("{}\n")
    (run / "plan.json").write_text('{"from": "/", "out": "/", "jobs": [1]}')
    (images := tmp_path / "images").mkdir()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(images / "a.png")
    (images / "data_batch_1.bin").write_bytes(bytes(3073))
    (images / "data_batch_1").write_bytes(python_batch(bytes(3072)))
    return {
        "rows": lambda: read_rows(shard),
        "frames": lambda: list(read_frames(shard)),
        "attributes": lambda: read_attributes(shard),
        "frame size": lambda: read_frame_size([shard]),
        "decoded set": lambda: open_dataset(data, cache),
        "decoded actions": lambda: store.array("action"),
        "decoded frames": store.frames,
        "checksums": lambda: verify_store(store),
        "what a folder keeps": lambda: kept_in(data),
        "encoder": lambda: load_encoder(encoder),
        "policy": lambda: load_policy(policy),
        "step of a policy": lambda: policy_step(policy),
        "checkpoint": lambda: Checkpoints(run).restore(lambda state: None),
        "actor": lambda: read_actor(actor),
        "ladder": lambda: read_ladder(ladder),
        "film": lambda: read_film(run / FILM_FILE),
        "episodes": lambda: read_episodes(run / "episodes.csv"),
        "episodes of a cut run": lambda: episodes_until(run / "episodes.csv", 1),
        "trajectory": lambda: read_trajectory(run / "trajectory.csv"),
        "results": lambda: read_results(run),
        "images": lambda: load_pool(str(images), 0),
        "image": lambda: _read_image(images / "a.png"),
        "CIFAR-10, binary": lambda: _read_cifar(images / "data_batch_1.bin"),
        "CIFAR-10, Python": lambda: _read_cifar(images / "data_batch_1"),
        "name of a pool": lambda: source_fingerprint(str(images)),
        "plan of a sweep": lambda: read_plan(run / "plan.json"),
    }


def test_too_many_open_files_is_reported_as_temporary(world):
    wrong = {}
    for name, read in world.items():
        with suppress(UserError) if name in ("plan of a sweep", "results") else nullcontext():  # only valid as JSON
            read()  # also imports dependencies
        try:
            with no_more_files():
                read()
        except UnavailableError as error:
            if any(word in str(error) for word in ADVICE) or "too many open files" not in str(error):
                wrong[name] = str(error)
        except Exception as error:
            wrong[name] = repr(error)
        else:
            wrong[name] = "read"
    assert wrong == {}


def test_permission_errors_are_not_reported_as_damage(world, tmp_path, monkeypatch):
    def refusing(open_file):
        def refuse(path, *arguments, **options):
            if not isinstance(path, int) and Path(os.fspath(path)).is_relative_to(tmp_path):
                raise PermissionError(errno.EACCES, "Permission denied")
            return open_file(path, *arguments, **options)

        return refuse

    for place in ("io.open", "builtins.open", "h5py.File", "safetensors.safe_open"):
        monkeypatch.setattr(place, refusing(pydoc.locate(place)))
    wrong = {}
    for name, read in world.items():
        try:
            read()
        except UserError as error:
            if "may not be used (permission denied); ask its owner for access" not in str(error):
                wrong[name] = str(error)
        except Exception as error:
            wrong[name] = repr(error)
    assert wrong == {}


@pytest.fixture
def shard(tmp_path) -> Path:
    return min(write_fake_set(tmp_path / "walker_walk" / "expert").glob("*.hdf5"))


def test_locked_shard_is_reported_as_temporary(shard):
    with shard.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(UnavailableError, match="HDF5_USE_FILE_LOCKING=FALSE"):
            read_rows(shard)
        end = run_to_end(["data", "check", str(shard.parent)])
        assert end.code == TEMPORARY, "sweeps retry this exit code"
        assert kept_in(shard.parent) == "a data set"
    assert run_to_end(["data", "check", str(shard.parent)]).code == 0


def test_shard_being_written_is_not_reported_as_damaged(tmp_path):
    with h5py.File(tmp_path / "open.hdf5", "w", libver="latest") as file:
        file["action"] = np.zeros(3)
        file.flush()
        copyfile(tmp_path / "open.hdf5", tmp_path / "copy.hdf5")
    with pytest.raises(UnavailableError, match="another program is writing it or was killed while writing"):
        read_rows(tmp_path / "copy.hdf5")


@pytest.mark.parametrize("place", ["File", "_hl.group.h5o.open"])
@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENFILE, errno.EBUSY])
def test_hdf5_system_errors_are_reported_as_temporary(shard, monkeypatch, place, number):
    """Within an open file h5py raises a KeyError, which `Group.get` treats as a missing key."""
    words = f"Unable to synchronously open object (file read failed: time = now\n, errno = {number}, buf = 0x0)"

    def fail(*_: object, **__: object) -> None:
        raise KeyError(words) if "h5o" in place else OSError(words)

    monkeypatch.setattr(f"h5py.{place}", fail)
    with pytest.raises(UnavailableError, match=os.strerror(number).lower()):
        read_rows(shard)


def test_damage_and_permissions_are_not_temporary(shard):
    content = shard.read_bytes()
    shard.write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="truncated, damaged") as damaged:
        read_rows(shard)
    assert not isinstance(damaged.value, UnavailableError)
    denied = system_error(shard, PermissionError(errno.EACCES, "Permission denied"))
    assert type(denied) is UserError
    assert "ask its owner" in str(denied)
    for error in (OSError("image file is truncated"), FileNotFoundError(errno.ENOENT, "none"), ValueError("no array")):
        assert system_error(shard, error) is None


def test_cache_without_locks_is_reported_as_temporary(shard, tmp_path, monkeypatch):
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(UnavailableError, match=r"cache: cannot be used now \(no locks available\)"):
        open_dataset(shard.parent, tmp_path / "cache")
