"""Collection and training of the navigation study use the seeds and settings that they are given."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from pretrain.train import Trainer
from tests.studies.navigation.test_train import smoke
from vd4rl_pomdp.envs.maze import MazeEnv
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.studies.navigation import collect, train
from vd4rl_pomdp.studies.navigation.train import ErrorSums, MazeData, ProbedObjective

MAZE = MAZES["three_curtains"]
UNEVEN = {"evaluation_windows": 5, "refit_windows": 7, "refit_steps": 3, "burn_in": 3}
"""Different numbers, in incomplete batches of 4 windows."""


def trainer_of(data: Path, **changes: object) -> tuple[Trainer, ProbedObjective]:
    config = smoke(data, Path(), **(UNEVEN | changes))
    return train.make_trainer(MazeData(config), config, torch.device("cpu"))


@pytest.mark.parametrize("maze", ["three_curtains", "first_person"])
def test_trajectories_start_and_explore_by_seed_and_number(maze, monkeypatch):
    drawn = []

    def controller(env, rng):
        drawn.append(rng.random())
        return lambda state, goal: np.zeros(2)

    monkeypatch.setattr(collect, "_environment", lambda name, repeat: MazeEnv(name, repeat, pixels=False))
    monkeypatch.setattr(collect, "_controller", controller)
    jobs = [(maze, number, seed, 2, 5) for number in (0, 1) for seed in (0, 1)]
    starts = [tuple(collect._roll_out(job)["physics"][0]) for job in jobs]
    assert (len(set(starts)), len(set(drawn))) == (4, 4)
    assert tuple(collect._roll_out(jobs[0])["physics"][0]) == starts[0]
    assert drawn[-1] == drawn[0]


def test_collection_settings_are_passed_on_and_recorded(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(collect, "collect_set", lambda *arguments: calls.append(arguments))
    changed = {"trajectories": 5, "trajectory_rows": 7, "action_repeat": 3, "seed": 2, "trajectories_per_shard": 2}
    config = collect.MazeCollectConfig.of("smoke", maze="hard_one_curtain", out=tmp_path, workers=3, **changed)
    collect.collect(config)
    ((_, recorded, shards, _, workers, *_),) = calls
    assert recorded == {"maze": "hard_one_curtain"} | changed
    assert workers == 3
    assert [job for shard in shards for job in shard.jobs] == [("hard_one_curtain", i, 2, 7, 3) for i in range(5)]
    style, found = MAZES["hard_one_curtain"].style, shards[0].attributes
    assert (found["seed"], found["action_repeat"], found["policy"]) == (2, 3, "planner")
    assert [found[name] for name in ("noise", "zero_share", "random_share")] == [style.noise, 0, 0]
    uneven = replace(MAZE, style=replace(MAZE.style, zero_share=0.25, random_share=0.5))
    monkeypatch.setitem(MAZES, MAZE.name, uneven)
    collect.collect(replace(config, maze=MAZE.name))
    assert [calls[1][2][0].attributes[name] for name in ("zero_share", "random_share")] == [0.25, 0.5]


def test_training_seeds_differ_in_networks_and_batches(maze_set):
    (one, probed), (other, others) = (trainer_of(maze_set, seed=seed) for seed in (0, 1))
    assert not torch.equal(probed.probe.net[0].weight, others.probe.net[0].weight)
    assert not torch.equal(probed.encoder.frame.project[0].weight, others.encoder.frame.project[0].weight)
    assert not torch.equal(one.batches.sample().key, other.batches.sample().key)


def test_training_uses_no_held_out_window_or_action(maze_set):
    trainer, probed = trainer_of(maze_set, batch_size=256)
    assert (trainer.batches.sample().key >> 20).max() == probed.data.first_held_out - 1 == 10
    assert torch.equal(probed.data.training_actions, probed.data.dataset.action.view(12, 40, 2)[:11, 1:].flatten(0, 1))


def test_training_follows_the_learning_rate_schedule(maze_set):
    trainer, probed = trainer_of(maze_set, warm_up=4, learning_rate=0.8)
    rates = []
    for _ in range(2):
        trainer.update()
        rates += [float(group["lr"]) for group in trainer.optimiser.param_groups]
    assert rates == pytest.approx([train.learning_rate(probed.config, step) for step in (0, 1)]) == [0.2, 0.4]


def test_exogenous_noise_depends_on_row_seed_and_weight(maze_set, tmp_path):
    for level in range(10, 90, 10):  # uniform images, so that the median of what they add is their level
        Image.fromarray(np.full((4, 4, 3), level, np.uint8)).save(tmp_path / f"{level}.png")

    def added(**changes: object) -> list[float]:
        exogenous = {} if changes.pop("clean", False) else {"exogenous": str(tmp_path)}
        data = MazeData(smoke(maze_set, Path(), **exogenous, **changes))
        return data.view.observe(torch.arange(40)).float().flatten(1).median(1).values

    clean = added(clean=True)
    half, whole, other = (added(exogenous_weight=w, seed=s) - clean for w, s in ((0.5, 0), (0.25, 0), (0.5, 1)))
    assert len(set(half.tolist())) > 4, "rows have images of their own"
    assert (half - 2 * whole).abs().max() <= 1
    assert not torch.equal(half, other)


@pytest.fixture
def measured(monkeypatch) -> list[tuple]:
    """Arguments of every measurement of errors."""
    calls, add = [], ErrorSums.add

    def record(self, *arguments):
        calls.append(arguments)
        add(self, *arguments)

    monkeypatch.setattr(ErrorSums, "add", record)
    return calls


def test_errors_count_the_windows_rows_and_curtains_of_the_settings(maze_set, measured):
    trainer, probed = trainer_of(maze_set)
    trainer.update()
    train.evaluate(probed)
    train.refitted_errors(probed)
    assert [len(truth) for _, truth, *_ in measured] == [4, 4, 1, 4, 1, 4, 1], "a batch, then 5 windows three times"
    assert {burn_in for *_, burn_in in measured} == {3}
    covered = []
    for _, truth, hidden, _ in measured:
        states = (truth * probed.data.std + probed.data.mean).numpy()
        covered += (torch.from_numpy(MAZE.hidden(states)) == hidden).flatten().tolist()
    assert np.mean(covered) > 0.99
    assert any(hidden.any() for _, _, hidden, _ in measured)


def test_probe_is_refitted_with_its_settings(maze_set, monkeypatch):
    calls, refit = [], train.refit

    def record(features, truth, steps, seed):
        calls.append((features.shape, truth.shape, steps, seed))
        return refit(features, truth, steps, seed)

    monkeypatch.setattr(train, "refit", record)
    probed = trainer_of(maze_set, seed=2)[1]
    train.refitted_errors(probed)
    rows = 7 * (16 - 3)
    assert calls == [((rows, probed.encoder.dim), (rows, 4), 3, 2)]


def test_refitted_probe_standardises_and_is_seeded():
    features = 100 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) + 50
    one, other = (train.refit(features, torch.zeros(500, 4), 1, seed) for seed in (0, 1))
    torch.testing.assert_close(one.standardise(features).std(0), torch.ones(3), atol=1e-2, rtol=0)
    torch.testing.assert_close(one.standardise(features).mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    assert not torch.equal(one.net[0].weight, other.net[0].weight)


def test_evaluation_averages_over_windows_in_the_training_precision(maze_set):
    plain, single, half = (
        trainer_of(maze_set, method="ah", **changes)[1] for changes in ({}, {"batch_size": 1}, {"precision": "bf16"})
    )
    losses, errors = train.evaluate(plain)
    assert train.evaluate(single)[0] == pytest.approx(losses, rel=1e-4)
    assert train.evaluate(half)[1] != errors
    one, other = (train.encode(probed, torch.tensor([0]))[0] for probed in (plain, half))
    assert not torch.equal(one, other)


def test_results_are_last_averages_and_losses_in_their_units(tmp_path, monkeypatch):
    rows = [{"step": 4, "state": 9.0}, {"step": 6, "state": 8.0}, {"step": 8, "state": 3.0}, {"step": 10, "state": 1.0}]
    rows = [row | {"action_loss": row["state"] / 10, "loss_k3": 0.5, "loss": 70.0} for row in rows]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    held_out = {"action_loss": 0.7, "loss_k3": 0.75, "loss": 80.0}
    monkeypatch.setattr(train, "evaluate", lambda probed: (held_out, {"state": 11.0}))
    refitted = {"training": {"state": 12.0}, "held_out": {"state": 13.0, "state_hidden": 14.0}}
    monkeypatch.setattr(train, "refitted_errors", lambda probed: (None, refitted))
    probed = SimpleNamespace(config=SimpleNamespace(method="mik+a", steps=10, average_last=4))
    found = train.measure(probed, tmp_path / "metrics.jsonl")[1]
    numbers = {tuple(row[name] for name in ("measure", "split", "probe", "rows", "k")): row["value"] for row in found}
    assert numbers == pytest.approx(
        {
            ("state_error", "training", "online", "all", 0): 2.0,
            ("state_error", "held_out", "online", "all", 0): 11.0,
            ("state_error", "training", "refit", "all", 0): 12.0,
            ("state_error", "held_out", "refit", "all", 0): 13.0,
            ("state_error", "held_out", "refit", "hidden", 0): 14.0,
            ("action_loss", "training", "", "all", 0): 20.0,
            ("action_loss", "training", "", "all", 3): 50.0,
            ("action_loss", "held_out", "", "all", 0): 70.0,
            ("action_loss", "held_out", "", "all", 3): 75.0,
        }
    )


def test_trajectory_is_the_first_held_out_one_in_the_simulators_units(maze_set, tmp_path):
    probed = trainer_of(maze_set)[1]
    guess = torch.tensor([0.1, 0.2, 0.3, 0.4])
    train.write_trajectory(tmp_path / "trajectory.csv", probed, lambda z: guess.expand(*z.shape[:2], 4))
    table = pd.read_csv(tmp_path / "trajectory.csv")
    names, states = ["x", "y", "vx", "vy"], probed.data.dataset.physics[11 * 40 :]
    np.testing.assert_allclose(table[names], states, atol=1e-4)
    estimates = (guess * probed.data.std + probed.data.mean).expand(40, 4)
    np.testing.assert_allclose(table[[f"estimated_{name}" for name in names]], estimates, atol=1e-4)
    assert table["hidden"].tolist() == MAZE.hidden(states).astype(int).tolist()


def test_untrained_reference_takes_no_step_and_its_card_says_so(maze_set, tmp_path):
    run = train.train(smoke(maze_set, tmp_path / "run", method="random", seed=3, **UNEVEN))
    card = load_encoder(run.path / "encoder")[1]
    assert (card.seed, card.steps, card.preset, card.quality) == (3, 0, "smoke", "planner")
    assert card.settings["burn_in"] == 3
    timing = json.loads((run.path / "timing.json").read_text())
    assert (timing["steps"], timing["frames"]) == (0, 0)
    assert timing["seconds"] < timing["total_seconds"], "without and with the measurements"
