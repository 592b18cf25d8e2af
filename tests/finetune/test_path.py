"""The path error compares the policy's action with the actor's mean action at the same row."""

import numpy as np
import pytest
import torch

from finetune import trainer
from finetune.train import finetune
from finetune.trainer import path_error
from tests.finetune.conftest import BRIEF
from tests.helpers_data import fake_rows, write_rows
from tests.helpers_stages import smoke_finetune
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.policies import load_actor

ROWS = 12


@pytest.fixture
def expert_episodes(tmp_path):
    """Two episodes with the expert's physics; frames and actions are fake."""
    env, actor = make_env(TASKS["walker_walk"], size=None, length=ROWS - 1), load_actor("walker_walk", "expert")
    steps, rng = [], np.random.default_rng(0)
    for seed in range(2):
        steps.append(env.reset(seed))
        while not steps[-1].last:
            steps.append(env.step(actor.act(steps[-1].state, rng)))
    rows = fake_rows([ROWS, ROWS]) | {"physics": np.stack([step.physics for step in steps])}
    attributes = {"task": "walker_walk", "set": "expert", "actor_sha256": actor.sha256}
    folder = write_rows(tmp_path / "walker_walk" / "expert_episodes", rows, attributes)
    return folder, np.stack([step.state for step in steps]), actor


def test_path_error_compares_with_actor_at_the_same_row(expert_episodes):
    folder, states, actor = expert_episodes
    shown = torch.from_numpy(np.stack([actor.act(state) for state in states]))
    path = open_dataset(folder), actor, lambda number: shown[number * ROWS : (number + 1) * ROWS]
    assert path_error(*path, lambda z: z) == pytest.approx(0, abs=1e-10)
    assert path_error(*path, lambda z: z + 0.1) == pytest.approx(0.01, rel=1e-4)
    assert path_error(*path, lambda z: z.roll(1, 0)) > 0.01, "the rows differ"


def test_path_error_ignores_episodes_of_one_row(expert_episodes, monkeypatch):
    folder, states, actor = expert_episodes
    dataset = open_dataset(folder)
    ends = torch.tensor([ROWS, ROWS + 1, 2 * ROWS])
    monkeypatch.setattr(dataset, "episode_start", torch.tensor([0, ROWS, ROWS + 1]))
    monkeypatch.setattr(dataset, "episode_end", ends)
    shown = torch.from_numpy(np.stack([actor.act(state) for state in states]))
    path = dataset, actor, lambda number: shown[dataset.episode_start[number] : ends[number]]
    assert path_error(*path, lambda z: z + 0.1) == pytest.approx(0.01, rel=1e-4)


@pytest.mark.parametrize("views", [1, 0])
def test_run_stores_path_error_and_action_errors(expert_episodes, encoder, tmp_path, monkeypatch, views):
    monkeypatch.setattr(trainer, "STANDARDISED_BY", 16)
    folder, _, actor = expert_episodes
    config = smoke_finetune(encoder, folder, tmp_path / "run", views=views, **BRIEF)
    run = finetune(config).path
    reference = Reference.read(run)
    assert reference.actor == {"task": "walker_walk", "quality": "expert", "sha256": actor.sha256}
    assert 0 < reference.path_error < 4
    rows = (run / "episodes.csv").read_text().splitlines()[1:]
    assert len(rows) == 2
    assert all(0 < float(row.rpartition(",")[2]) < 4 for row in rows)
