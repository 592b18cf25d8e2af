"""What is held out stays held out: changing one part's true states changes that part's errors and nothing else."""

from pathlib import Path

import pytest
import torch

from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.data import open_data
from vd4rl_pomdp.studies.navigation.measure import evaluate, refitted_errors
from vd4rl_pomdp.studies.navigation.trainer import NavigationTrainer, make_objective


@pytest.fixture
def trainer(maze_set: Path, tmp_path_factory, monkeypatch) -> NavigationTrainer:
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path_factory.getbasetemp() / "maze-cache"))
    config = NavigationConfig.of("smoke", data=maze_set, out=Path(), refit_steps=20, precision="fp32")
    torch.manual_seed(0)
    data = open_data(config)
    return NavigationTrainer(make_objective(data, config), data.on(torch.device("cpu")), config)


def shift_states(trainer: NavigationTrainer, held_out: bool) -> None:
    """Move the true states of the training or of the held-out rows."""
    split = int(trainer.data.dataset.episode_start[trainer.data.first_held_out])
    trainer.data.states.values[slice(split, None) if held_out else slice(split)] += 3


def test_a_refitted_probe_knows_nothing_of_held_out_states(trainer: NavigationTrainer):
    probe, before = refitted_errors(trainer)
    shift_states(trainer, held_out=True)
    again, after = refitted_errors(trainer)
    for one, other in zip(probe.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    assert before["training"] == after["training"]
    assert after["held_out"]["state"] > before["held_out"]["state"] + 100


def test_the_probe_beside_the_objective_is_measured_on_held_out_states_alone(trainer: NavigationTrainer):
    losses, before = evaluate(trainer)
    shift_states(trainer, held_out=False)
    assert evaluate(trainer) == (losses, before)
    shift_states(trainer, held_out=True)
    assert evaluate(trainer)[1]["state"] > before["state"] + 100
