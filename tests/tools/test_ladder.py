"""The ladder of budgets: kept policies, their cloning losses, and the rule for a budget."""

import csv
import importlib
import json
import shutil

import numpy as np
import pytest
import torch

from finetune.evaluation import Agent
from finetune.train import finetune
from tests.helpers_data import write_fake_set
from tests.helpers_stages import smoke_finetune
from tests.tools.test_scripts import SCRIPTS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import View, open_dataset
from vd4rl_pomdp.nn.encoder_folder import load_encoder
from vd4rl_pomdp.nn.policy import load_policy
from vd4rl_pomdp.runs.files import read_json, write_json


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    return importlib.import_module


@pytest.fixture
def ladder_run(scripts, data, encoder, tmp_path):
    """Folder of a ladder with one run of two rungs and both policies."""
    work = tmp_path / "work"
    out = work / "runs" / "walker_walk" / "finetune-td3_bc"
    keep = scripts("ladder").keep_policies
    for updates in (2, 4):
        settings = {"updates": updates, "eval_every": 2, "batch_size": 4, "eval_length": 2, "checkpoint_every": 2}
        shutil.rmtree(out, ignore_errors=True)
        finetune(smoke_finetune(encoder, data, out, **settings))
        keep(work / "runs", work / "snapshots")
    record = read_json(out / "config.json")
    write_json(out / "config.json", record | {"collection": {"task": "walker_walk", "quality": "expert"}})
    return work


def test_ladder_keeps_policies_by_update(ladder_run):
    kept = ladder_run / "snapshots" / "walker_walk" / "finetune-td3_bc"
    assert sorted(path.name for path in kept.iterdir()) == ["2.safetensors", "4.safetensors"]
    last = ladder_run / "runs" / "walker_walk" / "finetune-td3_bc" / "policy" / "model.safetensors"
    assert (kept / "4.safetensors").read_bytes() == last.read_bytes() != (kept / "2.safetensors").read_bytes()


def test_curve_contains_logged_training_rows(scripts, tmp_path):
    losses = {"critic_loss": 1, "actor_loss": 2, "bc_loss": 3}
    rows = [
        {"step": 500, "q": 1 / 3} | losses,
        {"step": 500, "eval/score/none": 3.0},
        {"step": 1000, "q": 2.0} | losses,
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    curve = scripts("ladder").curve_of(tmp_path / "metrics.jsonl")
    assert [(row["step"], row["q"]) for row in curve] == [(500, "0.33333"), (1000, "2")]


def test_curves_of_runs_in_other_work_folders_are_kept(scripts, ladder_run, tmp_path, monkeypatch):
    script, results = scripts("ladder"), tmp_path / "results"
    monkeypatch.setattr(script, "RESULTS", results)
    results.mkdir()
    (results / "README.md").touch()
    before = "run,step,q,critic_loss,actor_loss,bc_loss\n" + "".join(
        f"a/finetune-bc,{n},1,2,3,4\n" for n in (500, 1000)
    )
    (results / "curves.csv").write_text(before)
    for _ in range(2):
        assert script.keep_rows(ladder_run / "runs") == 0
        kept = (results / "curves.csv").read_text()
        assert kept.startswith(before), kept
        rows = list(csv.DictReader(kept.splitlines()))[2:]
        assert [(row["run"], row["step"]) for row in rows] == [("walker_walk/finetune-td3_bc", "4")]


def test_cloning_losses_match_an_agent(scripts, ladder_run, encoder, monkeypatch):
    script, asked = scripts("ladder_policies"), []

    def collect(config):
        asked.append(config)
        write_fake_set(config.out, [12, 9])
        write_json(config.out / "provenance.json", {})

    run = ladder_run / "runs" / "walker_walk" / "finetune-td3_bc"
    monkeypatch.setattr(script, "collect", collect)
    config = script.Config("cloning", ladder_run, ladder_run / "cloning.csv")
    script.main(config)
    first = config.out.read_text()
    rows = list(csv.DictReader(first.splitlines()))
    assert [(row["run"], row["step"]) for row in rows] == [("walker_walk/finetune-td3_bc", step) for step in "24"]
    assert [(one.task, one.quality, one.episodes, one.seed) for one in asked] == [("walker_walk", "expert", 20, 10_000)]
    own = read_json(run / "config.json")["config"]["data"]
    for name, data in (("trained_on", own), ("held_out", ladder_run / "held_out" / "walker_walk" / "expert")):
        assert float(rows[1][name]) == pytest.approx(_loss(encoder, run / "policy", data), rel=1e-4)
    assert all(row["trained_on"] != row["held_out"] for row in rows)

    config.out.write_text("".join(first.splitlines(keepends=True)[:2]))
    script.main(config)
    assert config.out.read_text() == first
    assert len(asked) == 1, "held-out episodes are collected once"


def _loss(encoder, policy, data) -> float:
    """Mean squared error of an agent's actions in a dataset's episodes, given the stored previous actions."""
    network, card = load_encoder(encoder)
    agent, dataset = Agent(network, load_policy(policy)), open_dataset(data)
    view = View(dataset, CorruptionConfig.fill(card.corruption), 0, 0, "finetune", 1)  # trained on one view
    obs = view.observe(torch.arange(dataset.num_rows))
    squares = []
    for first, end in zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True):
        agent.reset()
        for row in range(first, end - 1):
            squares.append(np.square(agent.act(obs[row]) - dataset.action[row + 1].numpy()).mean())
            agent.set_last_action(dataset.action[row + 1].numpy())
    return float(np.mean(squares))


def test_critic_drift_is_measured_on_the_last_fifth(scripts):
    script = scripts("ladder_table")
    rising = {step: 100.0 + step for step in range(1, 101)}
    assert script.drift(rising, 100) == pytest.approx(20 / 190.5, rel=1e-4), "slope x length / mean"
    assert script.drift(rising, 50) == pytest.approx(10 / 145.5, rel=1e-4), "for a training that ended there"
    assert script.drift({step: -100.0 - step for step in rising}, 100) == pytest.approx(20 / 190.5, rel=1e-4)
    wavy = {step: 100.0 + (-1) ** step for step in range(1, 101)}
    assert abs(script.drift(wavy, 100)) < 0.02
    assert np.isnan(script.drift({90: 1.0, 100: 1.0}, 100)), "two values are too few for a slope"


def test_budget_is_the_first_converged_rung_near_the_lowest_loss(scripts):
    script = scripts("ladder_table")
    key = script.Key("walker_walk", "expert", "patch", "acro", 256, "bf16", 3000, 100, 4)

    def cell(*held_out, rises=0):
        """Rungs at 100 to 400 updates; the critic's value rises for `rises` updates and is then constant."""
        rising = {step: min(step, rises) + 1.0 for step in range(1, 401)}
        return script.Cell(key, rising, dict(zip((100, 200, 300, 400), held_out, strict=True)))

    assert script.budget([cell(0.5, 0.3, 0.2, 0.21)]) == 300, "the lowest"
    assert script.budget([cell(0.5, 0.203, 0.2, 0.21)]) == 200, "within 2% of it, and earlier"
    assert script.budget([cell(0.5, 0.203, 0.2, 0.21), cell(0.5, 0.4, 0.3, 0.3)]) == 300, "in every cell"
    assert script.budget([cell(0.2, 0.3, 0.4, 0.5), cell(0.5, 0.4, 0.3, 0.2)]) is None
    assert script.budget([]) is None
    both = [cell(0.2, 0.3, 0.31, 0.4), cell(0.4, 0.4, 0.305, 0.3, rises=200)]
    assert script.budget(both) == 300, "the lowest loss among rungs at which all critics have converged"
    assert script.budget([cell(0.1, 0.2, 0.3, 0.4, rises=300)]) == 400, "rungs of a rising critic do not count"
