import json
import signal
import sys
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.policies import read_actor

SETTINGS = {
    "mlp": {"critic_norm": True, "n_step": 3, "envs": 2, "updates_per_decision": 0.5},
    "simba": {"network": "simba", "learning_rate": 1e-3},
}


@pytest.fixture
def configure(monkeypatch):
    """Settings of a run with short episodes that trains after 40 decisions and lasts seconds."""
    from vd4rl_pomdp.policies import export, learner
    from vd4rl_pomdp.policies.config import PolicyConfig

    monkeypatch.setitem(TASKS._parts, "walker_walk", replace(TASKS["walker_walk"], decisions=100))
    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 20)
    monkeypatch.setattr(export, "CARD_EPISODES", 2)
    small = {"hidden": 16, "batch_size": 32, "replay_size": 2_000, "eval_every": 40, "eval_episodes": 1}
    small |= {"normalise": True, "refill": 20, "critic_warmup": 8}
    return lambda out, **more: PolicyConfig("walker_walk", Path(out), **(small | more))


@pytest.mark.parametrize("kind", SETTINGS)
def test_an_exported_actor_acts_like_the_learners_network(configure, kind, tmp_path):
    from vd4rl_pomdp.policies import learner

    config = configure(tmp_path, **SETTINGS[kind])
    model = learner.build(config, TASKS.named("walker_walk"))
    model.learn(120)
    assert model._n_updates > 0
    states = 3 * np.random.default_rng(0).standard_normal((6, 24)).astype(np.float32)
    wanted = model.policy._predict(learner._envs(model).normalize_obs(states), deterministic=True)
    exported = learner.export_actor(model, config, 120)
    exported.save(tmp_path / "actor.safetensors")
    read = read_actor(tmp_path / "actor.safetensors")
    np.testing.assert_allclose(np.stack([read.act(state) for state in states]), np.asarray(wanted), atol=1e-5)


def leaves(model):
    import jax

    from vd4rl_pomdp.policies import learner

    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(learner._states(model))]


def test_a_checkpoint_brings_everything_back(configure, tmp_path):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.train import train_policy

    config = configure(tmp_path, decisions=120, **SETTINGS["mlp"])
    files = train_policy(config)
    assert {path.name for path in files.values()} == {
        f"walker_walk_{q}.safetensors" for q in ("expert", "medium", "replay")
    }
    first, second = (learner.build(config, TASKS.named("walker_walk")) for _ in range(2))
    assert learner.restore_checkpoint(first, tmp_path) == 120
    learner.save_checkpoint(first, tmp_path)
    learner.restore_checkpoint(second, tmp_path)
    for one, other in zip(leaves(first), leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)
    for name in learner.REPLAY_ARRAYS:
        np.testing.assert_array_equal(getattr(first.replay_buffer, name), getattr(second.replay_buffer, name))
    np.testing.assert_array_equal(learner._envs(first).obs_rms.var, learner._envs(second).obs_rms.var)
    assert second.replay_buffer.timeouts[second.replay_buffer.pos - 1].all(), "a cut episode must not be continued"


def test_a_run_goes_on_and_forgets_what_it_wrote_after_its_checkpoint(configure, tmp_path, monkeypatch):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.export import read_curve
    from vd4rl_pomdp.policies.train import decisions_made, train_policy

    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 1_000)  # no update is compiled
    config = configure(tmp_path, decisions=80)
    train_policy(config)
    with (tmp_path / "curve.csv").open("a") as file:
        file.write("999,1.0\n")
    train_policy(replace(config, decisions=160))
    assert [step for step, _ in read_curve(tmp_path)] == [40, 80, 120, 160]
    assert decisions_made(tmp_path) == 160
    with pytest.raises(UserError, match="another n_step"):
        train_policy(replace(config, n_step=3))


def test_a_run_that_reached_its_return_stays_ended(configure, tmp_path, monkeypatch):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.train import decisions_made, train_policy

    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 1_000)  # no update is compiled
    config = configure(tmp_path, decisions=160, stop_at=-1.0)
    for _ in range(2):
        train_policy(config)
        assert decisions_made(tmp_path) == 40


def test_a_new_run_starts_where_committed_networks_stood(configure, tmp_path):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.export import NETWORKS, export_run, read_curve, snapshot_path
    from vd4rl_pomdp.policies.train import train_policy

    old, new = tmp_path / "old", tmp_path / "new"
    config = configure(old, decisions=80, **SETTINGS["mlp"])
    train_policy(config)
    model = learner.build(config, TASKS.named("walker_walk"))
    learner.start_from_networks(model, old / NETWORKS)
    before, trained = learner.export_actor(model, config, 0), read_actor(snapshot_path(old, 80))
    for name, value in trained.weights.items():
        np.testing.assert_array_equal(before.weights[name], value)
    critics = [np.asarray(x) for x in leaves_of(model.policy.qf_state.params)]
    model.num_timesteps = 80
    learner.refill(model, 20, 8)
    assert (model.num_timesteps, model._n_updates) == (100, 8)
    after = learner.export_actor(model, config, 0)
    assert all(
        np.array_equal(after.weights[n], v) for n, v in before.weights.items() if not n.startswith("observation")
    )
    assert any(not np.array_equal(x, y) for x, y in zip(critics, leaves_of(model.policy.qf_state.params), strict=True))
    kept = tmp_path / "kept"
    export_run(old, kept)  # what a repository would hold
    train_policy(configure(new, decisions=180, start_from=kept, **SETTINGS["mlp"]))
    assert [step for step, _ in read_curve(new)] == [40, 80, 140, 180]
    for step in (40, 80):
        taken, original = (read_actor(snapshot_path(run, step)) for run in (new, old))
        np.testing.assert_allclose(taken.weights["mean.weight"], original.weights["mean.weight"], atol=1e-3)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"temperature": 0.0}, "--temperature is 0"),
        ({"eval_episodes": 10_001}, "--eval-episodes is 10001; .* most 10000"),
    ],
)
def test_settings_that_would_stop_a_run_on_its_way_are_refused(configure, tmp_path, more, line):
    from vd4rl_pomdp.policies.train import train_policy

    with pytest.raises(UserError, match=line):
        train_policy(configure(tmp_path / "new", **more))
    assert not (tmp_path / "new").exists()


def test_a_run_that_goes_on_takes_no_episode_of_an_evaluation():
    from vd4rl_pomdp.policies.learner import _seed_from

    seeds = [_seed_from(0, decisions) for decisions in range(5_000, 300_001, 5_000)]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) > 100_000


def leaves_of(tree):
    import jax

    return jax.tree_util.tree_leaves(tree)


def test_a_start_that_does_not_fit_is_one_sentence(configure, tmp_path):
    from vd4rl_pomdp.policies.train import train_policy

    with pytest.raises(UserError, match=r"has no config.json and no curve.csv and no networks.safetensors"):
        train_policy(configure(tmp_path / "new", start_from=tmp_path))
    assert not (tmp_path / "new").exists()
    train_policy(configure(tmp_path / "old", decisions=20))
    with pytest.raises(UserError, match="networks of another shape"):
        train_policy(configure(tmp_path / "new", start_from=tmp_path / "old", hidden=8))
    for more, line in (
        ({"decisions": 40}, "old: has made 20 decisions, and --refill adds 20: nothing is left of --decisions 40"),
        ({"stop_at": 0.0}, "old: returns .* already; give a --stop-at above it"),
        ({"refill": 0}, "--refill 0 leaves no decision for --critic-warmup to learn from; give it 0, too"),
    ):
        with pytest.raises(UserError, match=line):
            train_policy(configure(tmp_path / "empty", start_from=tmp_path / "old", **more))
    (tmp_path / "old" / "curve.csv").write_text("decisions,return_mean\n")
    with pytest.raises(UserError, match=r"old: its curve\.csv holds no evaluation; --start-from takes a run that"):
        train_policy(configure(tmp_path / "empty", start_from=tmp_path / "old"))
    assert not (tmp_path / "empty").exists()


def test_a_folder_with_something_else_is_refused_untouched(configure, tmp_path):
    from vd4rl_pomdp.policies.train import train_policy

    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds no policy run"):
        train_policy(configure(tmp_path, decisions=40))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_without_the_training_library_nothing_is_begun(tmp_path, monkeypatch):
    from vd4rl_pomdp.policies.config import PolicyConfig
    from vd4rl_pomdp.policies.train import train_policy

    monkeypatch.setitem(sys.modules, "sbx", None)  # importing it raises ImportError
    with pytest.raises(UserError, match=r"pip install '.\[policy\]'"):
        train_policy(PolicyConfig("walker_walk", tmp_path / "run"))
    assert not list((tmp_path / "run").iterdir())


def test_a_damaged_run_is_one_sentence(configure, tmp_path, monkeypatch):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.export import export_run
    from vd4rl_pomdp.policies.train import decisions_made, train_policy

    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 1_000)  # no update is compiled
    config = configure(tmp_path / "run", decisions=40)
    train_policy(config)
    assert decisions_made(tmp_path / "run") == 40
    (tmp_path / "run" / "checkpoints" / "40.pt").write_bytes(b"cut")
    with pytest.raises(UserError, match="checkpoint is damaged"):
        train_policy(config)
    kept = tmp_path / "kept"
    export_run(tmp_path / "run", kept)
    with pytest.raises(UserError, match="keeps no snapshot"):
        export_run(kept, tmp_path / "again")
    (kept / "curve.csv").write_text("garbage,1\n2,3\n")
    with pytest.raises(UserError, match=r"curve.csv: is no learning curve"):
        export_run(kept, tmp_path / "again")
    (kept / "config.json").write_text("{")
    for attempt in (lambda: export_run(kept, tmp_path / "again"), lambda: train_policy(configure(kept))):
        with pytest.raises(UserError, match="cannot be read as JSON"):
            attempt()
    assert not (tmp_path / "again").exists()


def test_an_export_needs_no_training_library_and_names_the_one_that_trained(configure, tmp_path, monkeypatch):
    from vd4rl_pomdp.policies import export, learner
    from vd4rl_pomdp.policies.train import train_policy

    def installed(name):
        if name in ("sbx-rl", "jax"):
            raise PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 1_000)  # no update is compiled
    monkeypatch.setattr(learner, "version", lambda name: f"{name} of then")
    train_policy(configure(tmp_path / "run", decisions=40))
    monkeypatch.setattr(export, "version", installed)
    files = export.export_run(tmp_path / "run", tmp_path / "out")
    told = {"sbx-rl": "sbx-rl of then", "jax": "jax of then", "numpy": np.__version__}
    assert read_actor(files["expert"]).card["versions"].items() >= told.items()


def test_what_is_no_run_cannot_be_exported(tmp_path):
    from vd4rl_pomdp.policies.export import export_run

    with pytest.raises(UserError, match="not the folder of a policy run"):
        export_run(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_signal_keeps_the_decisions_made_and_one_process_owns_the_run(configure, tmp_path, monkeypatch):
    from vd4rl_pomdp.policies import learner
    from vd4rl_pomdp.policies.export import read_curve
    from vd4rl_pomdp.policies.state_env import StateEnv
    from vd4rl_pomdp.policies.train import decisions_made, train_policy
    from vd4rl_pomdp.runs.interrupt import Terminated
    from vd4rl_pomdp.runs.ownership import owned

    monkeypatch.setattr(learner, "RANDOM_DECISIONS", 1_000)  # no update is compiled
    step, calls = StateEnv.step, []

    def signalled(self, action):
        calls.append(1)
        if len(calls) == 10:
            signal.raise_signal(signal.SIGTERM)
        return step(self, action)

    config = configure(tmp_path / "run", decisions=80)
    with monkeypatch.context() as patch:
        patch.setattr(StateEnv, "step", signalled)
        with pytest.raises(Terminated) as end:
            train_policy(config)
    done = decisions_made(config.out)
    assert 0 < done < 40
    assert end.value.reason == f"{config.out} keeps {done} decisions"
    with owned(config.out), pytest.raises(UserError, match="run: is in use by process"):
        train_policy(config)
    train_policy(config)
    steps = [step for step, _ in read_curve(config.out)]
    assert steps[0] == done + 40
    assert steps[-1] >= 80
    stored = json.loads((config.out / "config.json").read_text())
    (config.out / "config.json").write_text(json.dumps(stored | {"format": 1}))
    with pytest.raises(UserError, match="holds a run of format 1, this version writes format"):
        train_policy(config)
