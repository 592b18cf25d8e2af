"""The tools that train and export actors, and the returns on the cards of shipped actors."""

import importlib
import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.policies import actor, load_actor, read_actor

TOOLS = Path(__file__).parents[2] / "tools"
ACTORS = sorted(p.stem for p in actor.ASSETS.glob("*.json"))
AT_LEAST = {
    **{"walker_walk_expert": 950, "cheetah_run_expert": 850, "humanoid_walk_expert": 700},
    **{"reacher_jump_expert": 850, "point_mass_cue_expert": 850},
    **{"walker_walk_medium": 450, "cheetah_run_medium": 400, "humanoid_walk_medium": 350},
    **{"reacher_jump_medium": 400, "point_mass_cue_medium": 500},
}
PLAYED = 8
"""Episodes of a card that are replayed."""
SETTINGS = {"critic_norm": True, "n_step": 3, "envs": 2, "updates_per_decision": 0.5}


@pytest.fixture
def exporting(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("export_actor")


@pytest.fixture
def training(exporting, monkeypatch):
    """The script, with short episodes and early training."""
    module = importlib.import_module("train_actor")
    monkeypatch.setitem(TASKS._parts, "walker_walk", replace(TASKS["walker_walk"], decisions=100))
    monkeypatch.setattr(module, "RANDOM_DECISIONS", 20)
    monkeypatch.setattr(exporting, "CARD_EPISODES", 2)
    return module


@pytest.fixture
def configure(training):
    small = {"hidden": 16, "batch_size": 32, "replay_size": 2_000, "eval_every": 40, "eval_episodes": 1}
    small |= {"normalise": True, "refill": 20, "critic_warmup": 8}
    return lambda out, **more: training.PolicyConfig("walker_walk", Path(out), **(small | more))


@pytest.mark.parametrize("name", ACTORS)
def test_actors_reproduce_returns_of_their_cards(exporting, name):
    """At least half match exactly: processors differ in a state's last bit, which some episodes amplify."""
    task, quality = name.rsplit("_", 1)
    shipped = load_actor(task, quality)
    card = json.loads((actor.ASSETS / f"{name}.json").read_text())
    assert {k: card[k] for k in shipped.card} == shipped.card
    assert len(card["returns"]) == exporting.CARD_EPISODES
    assert card["return_mean"] == round(float(np.mean(card["returns"])), 3) >= AT_LEAST.get(name, 0)
    differing = [k for k in ("mujoco", "dm-control") if version(k) != card["versions"][k]]
    if differing:
        pytest.skip(f"the card was written with another {' and '.join(differing)}")
    found = np.array(exporting.episode_returns(shipped, TASKS.named(task), PLAYED))
    recorded = np.array(card["returns"][:PLAYED])
    assert (found == recorded).sum() >= PLAYED / 2, f"{found} in place of {recorded}"


def test_exported_actor_equals_learner_network(training, configure, tmp_path):
    config = configure(tmp_path, **SETTINGS)
    model = training.build(config, TASKS.named("walker_walk"))
    model.learn(120)
    assert model._n_updates > 0
    states = 3 * np.random.default_rng(0).standard_normal((6, 24)).astype(np.float32)
    wanted = model.policy._predict(model.get_vec_normalize_env().normalize_obs(states), deterministic=True)
    training.export_actor(model, config, 120).save(tmp_path / "actor.safetensors")
    read = read_actor(tmp_path / "actor.safetensors")
    np.testing.assert_allclose(np.stack([read.act(state) for state in states]), np.asarray(wanted), atol=1e-5)


def leaves(tree):
    import jax

    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(tree)]


def test_actor_training_resumes_and_warm_starts(training, exporting, configure, tmp_path):
    config = configure(tmp_path / "run", decisions=80, **SETTINGS)
    files = training.train_actor(config)
    names = {f"walker_walk_{quality}.safetensors" for quality in ("expert", "medium", "replay")}
    assert {path.name for path in files.values()} == names
    first, second = (training.build(config, TASKS.named("walker_walk")) for _ in range(2))
    assert training.restore_checkpoint(first, config.out) == 80
    training.save_checkpoint(first, config.out)
    training.restore_checkpoint(second, config.out)
    for one, other in zip(leaves(training._states(first)), leaves(training._states(second)), strict=True):
        np.testing.assert_array_equal(one, other)
    for name in training.REPLAY_ARRAYS:
        np.testing.assert_array_equal(getattr(first.replay_buffer, name), getattr(second.replay_buffer, name))
    assert second.replay_buffer.timeouts[second.replay_buffer.pos - 1].all(), "a cut episode must not be continued"

    with (config.out / "curve.csv").open("a") as file:
        file.write("999,1.0\n")
    training.train_actor(replace(config, decisions=120))
    steps = [step for step, _ in exporting.read_curve(config.out)]
    assert steps == [40, 80, 120], "rows after the checkpoint are dropped"
    with pytest.raises(UserError, match="differs in n_step"):
        training.train_actor(replace(config, n_step=1))

    kept = tmp_path / "kept"
    exporting.export_run(config.out, kept)  # as committed to a repository
    new = configure(tmp_path / "new", decisions=180, start_from=kept, **SETTINGS)
    training.train_actor(new)
    assert [step for step, _ in exporting.read_curve(new.out)] == [40, 80, 120, 180]
    for step in (40, 80):
        taken, original = (read_actor(exporting.snapshot_path(run, step)) for run in (new.out, config.out))
        np.testing.assert_allclose(taken.weights["mean.weight"], original.weights["mean.weight"], atol=1e-3)


def test_refill_trains_only_critics(training, configure, tmp_path):
    config = configure(tmp_path, **SETTINGS)
    model = training.build(config, TASKS.named("walker_walk"))
    before, critics = training.export_actor(model, config, 0), leaves(model.policy.qf_state.params)
    model._setup_learn(0)
    training.refill(model, 40, 8)
    after = training.export_actor(model, config, 0)
    learned = [name for name in before.weights if not name.startswith("observation")]
    assert all(np.array_equal(after.weights[name], before.weights[name]) for name in learned)
    assert any(not np.array_equal(x, y) for x, y in zip(critics, leaves(model.policy.qf_state.params), strict=True))


def test_foreign_folder_is_rejected_unchanged(training, exporting, configure, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds no training run"):
        training.train_actor(configure(tmp_path))
    with pytest.raises(UserError, match="keeps no snapshot"):
        exporting.export_run(tmp_path, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
