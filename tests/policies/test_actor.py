import numpy as np
import pytest
from safetensors.numpy import save_file

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.policies import Actor, Ladder, actor, load_actor, load_ladder, read_actor
from vd4rl_pomdp.policies.actor import read_ladder

LADDERS = sorted(p.stem.removesuffix("_replay") for p in actor.ASSETS.glob("*_replay.safetensors"))


def test_shipped_actors_are_complete_and_small():
    assert {"walker_walk", "cheetah_run", "humanoid_walk", "reacher_jump", "point_mass_cue"} <= set(LADDERS)
    assert sum(p.stat().st_size for p in actor.ASSETS.iterdir()) < 10e6


@pytest.mark.parametrize("task", LADDERS)
def test_ladder_ends_with_the_medium_actor(task):
    ladder, medium = load_ladder(task), load_actor(task, "medium")
    steps = ladder.card["decisions"]
    assert steps == sorted(set(steps))
    assert steps[-1] == medium.card["decisions"]
    assert 10 <= len(steps) <= 15
    top = ladder.rungs[-1]
    for name, value in medium.weights.items():
        np.testing.assert_array_equal(top.weights[name], value.astype(np.float16).astype(np.float32))
    state = np.linspace(-1, 1, TASKS.named(task).layout.state_dim, dtype=np.float32)
    np.testing.assert_allclose(top.act(state), medium.act(state), atol=0.02)


def numbered(value):
    return Actor({"mean.weight": np.full((2, 1), value, np.float32), "mean.bias": np.zeros(1, np.float32)}, {})


def test_ladder_returns_the_nearest_rung():
    ladder = Ladder.of([numbered(1), numbered(2), numbered(3)], {"decisions": [20, 60, 100]})
    acting = [ladder.actor_at((episode + 0.5) / 10) for episode in range(10)]
    assert [a and a.weights["mean.weight"][0, 0] for a in acting] == [None, 1, 1, 1, 2, 2, 2, 2, 3, 3]


def test_sampled_actions_are_centred_on_the_mean_action():
    shipped = load_actor("walker_walk", "expert")
    state, rng = np.zeros(24, np.float32), np.random.default_rng(0)
    sampled = np.stack([shipped.act(state, rng) for _ in range(500)])
    assert sampled.dtype == np.float32
    assert (np.abs(sampled) <= 1).all()
    assert sampled.std(0).min() > 0.01
    below = (sampled < shipped.act(state)).mean(0)  # tanh keeps the median
    assert np.allclose(below, 0.5, atol=0.08)


def test_invalid_actor_files_are_rejected(tmp_path, monkeypatch):
    path = tmp_path / "actor.safetensors"
    path.write_bytes(b"\x80\x04 a pickle")
    with pytest.raises(UserError, match="not an actor file"):
        read_actor(path)
    load_actor("walker_walk", "medium").save(path)
    with pytest.raises(UserError, match="trained on walker_walk, not on cheetah_run"):
        read_actor(path, "cheetah_run")
    monkeypatch.setattr(actor, "ASSETS", tmp_path)
    with pytest.raises(UserError, match="no expert actor ships for humanoid_walk"):
        load_actor("humanoid_walk", "expert")
    with pytest.raises(UserError, match="no replay actor ships for humanoid_walk"):
        load_ladder("humanoid_walk")


HEADS = ("mean", "log_std")
SPOILT = {
    "none": lambda weights: {"x": np.zeros(3, np.float32)},
    "narrow": lambda weights: weights | {"hidden.0.weight": weights["hidden.0.weight"][:20]},
    "wide": lambda weights: (
        weights | {f"{n}.{k}": np.repeat(weights[f"{n}.{k}"], 2, -1) for n in HEADS for k in ("weight", "bias")}
    ),
    "nan": lambda weights: weights | {"log_std.bias": np.full_like(weights["log_std.bias"], np.nan)},
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_unfit_actor_weights_are_rejected(tmp_path, spoil):
    shipped, path = load_actor("walker_walk", "medium"), tmp_path / "actor.safetensors"
    Actor(spoil(shipped.weights), shipped.card).save(path)
    with pytest.raises(UserError, match="its weights do not fit an actor of walker_walk"):
        read_actor(path, "walker_walk")


def test_ladders_and_actors_are_not_interchangeable():
    with pytest.raises(UserError, match="do not fit an actor"):
        read_actor(actor.ASSETS / "walker_walk_replay.safetensors")
    with pytest.raises(UserError, match="contains no actor snapshots"):
        read_ladder(actor.ASSETS / "walker_walk_medium.safetensors")


@pytest.mark.parametrize("card", [{}, {"card": "{"}, {"card": "[1]"}, {"card": "3"}, {"card": "{}"}])
def test_actor_without_valid_card_is_rejected(tmp_path, card):
    path = tmp_path / "actor.safetensors"
    save_file(load_actor("walker_walk", "medium").weights, path, card)
    with pytest.raises(UserError, match=r"not an actor file|trained on None"):
        read_actor(path, "walker_walk")
