import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers_data import read_shard
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import collect as module
from vd4rl_pomdp.data import open_dataset, parity
from vd4rl_pomdp.data.collect import CollectConfig, collect
from vd4rl_pomdp.data.folder import shard_paths
from vd4rl_pomdp.data.format import read_attributes
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.envs.dmc import replay_rewards
from vd4rl_pomdp.policies import Actor, Ladder

LENGTH = 5


def config(out, **changes):
    settings = {"task": "walker_walk", "quality": "random", "episodes": 3, "workers": 1, "episodes_per_shard": 2}
    return CollectConfig(out=out, **(settings | changes))


def contents(folder):
    """Bytes of the files that a repeated collection must reproduce."""
    quoting = ("provenance.json", "card.md")  # they name command and commit
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name not in quoting}


def actor(seed):
    rng = np.random.default_rng(seed)
    sizes = {"hidden.0": (24, 256), "hidden.1": (256, 256), "mean": (256, 6), "log_std": (256, 6)}
    weights = {f"{n}.weight": 0.1 * rng.standard_normal(s, dtype=np.float32) for n, s in sizes.items()}
    weights |= {f"{n}.bias": np.zeros(s[1], np.float32) for n, s in sizes.items()}
    return Actor(weights, {"task": "walker_walk"}, sha256=f"{seed}" * 64)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted collection."""
    out = tmp_path_factory.mktemp("collect") / "set"
    collect(config(out), LENGTH)
    return out


def test_stored_actions_replay_to_stored_rewards(whole):
    shard = read_shard(whole / "0_walker_walk_random.hdf5")
    for episode in range(2):
        rows = slice(episode * (LENGTH + 1), (episode + 1) * (LENGTH + 1))
        step_type, action, reward = (shard[key][rows] for key in ("step_type", "action", "reward"))
        assert step_type.tolist() == [0] + [1] * (LENGTH - 1) + [2]
        assert not action[0].any()
        assert reward[0] == 0
        np.testing.assert_array_equal(replay_rewards("walker_walk", shard["physics"][rows][0], action[1:]), reward[1:])


def test_resuming_with_another_renderer_is_rejected(tmp_path, monkeypatch):
    out, info = tmp_path / "set", render_info("walker_walk")
    collect(config(out, episodes=2, episodes_per_shard=1), LENGTH)
    shard = out / "1_walker_walk_random.hdf5"
    shard.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(parity, "render_info", lambda task: info | {"canary": "other", "gl_renderer": "another GPU"})
        with pytest.raises(
            UserError, match=r"its shards were rendered by .*, and another GPU renders different pixels"
        ):
            collect(config(out, episodes=2, episodes_per_shard=1), LENGTH)
    assert not shard.exists()
    collect(config(out, episodes=2, episodes_per_shard=1), LENGTH)
    assert json.loads((out / "provenance.json").read_text())["render"] == info


def test_resumed_collection_writes_identical_files(whole, tmp_path, monkeypatch):
    out = tmp_path / "set"
    roll_out = module._roll_out

    def fail_in_the_second_shard(job):
        if job.episode == 2:
            raise KeyboardInterrupt
        return roll_out(job)

    with monkeypatch.context() as patch:
        patch.setattr(module, "_roll_out", fail_in_the_second_shard)
        with pytest.raises(KeyboardInterrupt):
            collect(config(out), LENGTH)
    seen = sorted(p.name for p in out.iterdir() if not p.name.startswith("."))
    assert seen == ["0_walker_walk_random.hdf5", "collection.json"]
    with pytest.raises(UserError, match="set: the dataset's collection is not finished"):
        shard_paths(out)
    (out / ".1_walker_walk_random.hdf5.tmp").write_bytes(b"half")
    first = (out / "0_walker_walk_random.hdf5").stat().st_mtime_ns
    collect(config(out), LENGTH)
    assert contents(out) == contents(whole)
    assert (out / "0_walker_walk_random.hdf5").stat().st_mtime_ns == first
    assert json.loads((out / "provenance.json").read_text())["frames"] == LENGTH + 1, "frames of this call"
    (out / "1_walker_walk_random.hdf5").unlink()
    collect(config(out), LENGTH)
    assert contents(out) == contents(whole), "a lost shard is collected again"


def test_collection_does_not_depend_on_worker_count(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "load_actor", lambda task, quality: actor(1))
    for workers in (1, 2):
        collect(config(tmp_path / str(workers), quality="expert", episodes=2, workers=workers), LENGTH)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_medium_expert_is_half_medium_then_half_expert(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "load_actor", lambda task, quality: actor({"medium": 1, "expert": 2}[quality]))
    paths = collect(config(tmp_path, quality="medium_expert", episodes=4, episodes_per_shard=1), LENGTH)
    names = [path.name for path in paths]
    assert names == [f"{i}_walker_walk_{quality}.hdf5" for quality in ("medium", "expert") for i in range(2)]
    attributes = [read_attributes(path) for path in paths]
    assert [a["policy"] for a in attributes] == ["medium"] * 2 + ["expert"] * 2
    assert [a["actor_sha256"][0] for a in attributes] == ["1"] * 2 + ["2"] * 2
    assert {a["set"] for a in attributes} == {"medium_expert"}
    assert not np.array_equal(read_shard(paths[0])["physics"][0], read_shard(paths[2])["physics"][0])


def test_medium_replay_uses_training_snapshots_in_order(tmp_path, monkeypatch):
    ladder = Ladder.of([actor(1), actor(2), actor(3)], {"task": "walker_walk", "decisions": [20, 60, 100]})
    monkeypatch.setattr(module, "load_ladder", lambda task: replace(ladder, sha256="c" * 64))
    acting = []
    roll_out = module._roll_out

    def note(job):
        acting.append(job.actor and float(job.actor.weights["mean.weight"][0, 0]))
        return roll_out(job)

    monkeypatch.setattr(module, "_roll_out", note)
    paths = collect(config(tmp_path, quality="medium_replay", episodes=5, episodes_per_shard=5), LENGTH)
    tops = [float(rung.weights["mean.weight"][0, 0]) for rung in ladder.rungs]
    assert acting == [None, tops[0], tops[1], tops[1], tops[2]]
    assert read_attributes(paths[0])["actor_sha256"] == "c" * 64
    assert "Regenerated from snapshots of the training run" in (tmp_path / "card.md").read_text()


def test_provenance_is_separate_from_config(whole):
    provenance = json.loads((whole / "provenance.json").read_text())
    assert provenance["frames"] == 3 * (LENGTH + 1)
    assert provenance["render"]["canary"]
    assert "mujoco" in provenance["versions"]
    stored = json.loads((whole / "collection.json").read_text())
    assert {"workers", "out"}.isdisjoint(stored)


@pytest.mark.parametrize("change", [{"seed": 1}, {"frame_size": 64}, {"render": "exact"}, {"task": "cheetah_run"}])
def test_collecting_into_folder_of_another_config_is_rejected(whole, change):
    before = contents(whole)
    with pytest.raises(UserError, match=f"differs in {next(iter(change))}"):
        collect(config(whole, **change), LENGTH)
    assert contents(whole) == before


def test_collecting_into_foreign_folder_is_rejected(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds no collected dataset"):
        collect(config(tmp_path), LENGTH)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "walker_run"}, "unknown task"),
        ({"quality": "mixed"}, "unknown quality to collect 'mixed': choose one of"),
        ({"actor": Path("a.safetensors"), "quality": "medium_replay"}, "--actor is for medium or expert"),
        ({"episodes": 1, "quality": "medium_expert"}, "at least 2 for medium_expert"),
        ({"actor": Path("a.safetensors"), "quality": "medium_expert"}, "--actor is for medium or expert"),
        ({"actor": Path("a.safetensors"), "quality": "expert"}, "a.safetensors"),
        ({"quality": "expert_noisy", "action_noise": 0.1}, "expert_noisy has its own noise"),
        ({"task": "humanoid_walk", "quality": "medium_replay"}, "actor ships for humanoid_walk .*train_actor.py huma"),
        ({"task": "humanoid_walk", "quality": "medium_expert"}, "actor ships for humanoid_walk .*train_actor.py huma"),
    ],
)
def test_invalid_collect_settings_write_nothing(tmp_path, monkeypatch, change, message):
    monkeypatch.setattr("vd4rl_pomdp.policies.actor.ASSETS", tmp_path / "none")  # no actor ships
    with pytest.raises(UserError, match=message):
        collect(config(tmp_path / "set", **change), LENGTH)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("changes", "name", "std"),
    [
        ({"quality": "expert_noisy"}, "expert_noisy", 0.5),
        ({"quality": "expert", "action_noise": 0.25}, "expert_noise0.25", 0.25),
    ],
)
def test_action_noise_is_executed_and_recorded(monkeypatch, tmp_path, changes, name, std):
    monkeypatch.setattr(module, "load_actor", lambda task, quality: actor(1))
    out = tmp_path / "set"
    shards = collect(config(out, episodes=2, **changes), LENGTH)
    stored = read_shard(shards[0])
    rows = slice(0, LENGTH + 1)
    action, reward = stored["action"][rows], stored["reward"][rows]
    np.testing.assert_array_equal(replay_rewards("walker_walk", stored["physics"][0], action[1:]), reward[1:])
    quiet = collect(config(tmp_path / "quiet", episodes=2, quality="expert"), LENGTH)
    noise = action[1] - read_shard(quiet[0])["action"][1]
    assert 0 < np.abs(noise).max() < 6 * std
    assert all(read_attributes(shard)["set"] == name for shard in shards)
    assert {read_attributes(shard)["action_noise"] for shard in shards} == {std}
    assert f"standard deviation | {std} |" in (out / "card.md").read_text()
    assert open_dataset(out, cache=tmp_path / "cache").quality == name
    assert "action_noise" not in read_attributes(quiet[0])


def test_action_noise_has_requested_standard_deviation(tmp_path):
    job = module._job(config(tmp_path, quality="expert_noisy"), actor(1), 0, 200)
    still = replace(actor(1), weights={k: 0 * v for k, v in actor(1).weights.items()})
    still.weights["log_std.bias"][:] = -20
    noise = module._roll_out(replace(job, actor=still, size=None))["action"][1:]
    assert noise[np.abs(noise) < 1].std() == pytest.approx(0.4371, abs=0.03)  # a Gaussian of 0.5, cut at +-1
    assert noise.mean() == pytest.approx(0.0, abs=0.05)


def test_unrendered_episodes_equal_rendered_ones(tmp_path):
    settings = config(tmp_path / "set", quality="medium_replay", episodes=2)
    rendered = [read_shard(path) for path in collect(replace(settings, out=tmp_path / "rendered"), LENGTH)]
    played = list(module.play(settings, LENGTH))
    for key in ("action", "reward", "physics", "step_type"):
        np.testing.assert_array_equal(np.concatenate([one[key] for one in played]), rendered[0][key])
    assert "observation" not in played[0]
    assert not (tmp_path / "set").exists()


def test_seeds_and_episodes_have_their_own_states_actions_and_noise():
    def played(**changes):
        return list(module.play(config(Path(), episodes=2, **changes), LENGTH))

    one, other = played(), played(seed=1)
    for first, second in ((one[0], other[0]), (one[1], other[1]), one):
        assert (first["physics"][0] != second["physics"][0]).any()
        assert (first["action"][1:] != second["action"][1:]).all()
    noise = [noisy["action"] - quiet["action"] for noisy, quiet in zip(played(action_noise=0.01), one, strict=True)]
    whole = (np.abs(one[0]["action"]) < 0.9) & (np.abs(one[1]["action"]) < 0.9)  # not clipped
    assert not np.isclose(noise[0][1:], noise[1][1:], atol=1e-5)[whole[1:]].any()


def test_recorded_actor_hashes_match_shipped_actors():
    recorded = json.loads((Path(__file__).parents[2] / "results/datasets/actors.json").read_text())
    for name, hashes in recorded.items():
        assert module.actor_hashes(CollectConfig(*name.split(), Path(), 200)) == hashes
