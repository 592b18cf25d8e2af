"""What is held out stays held out: changing one part's true states changes that part's errors and nothing else."""

from pathlib import Path

import pytest
import torch

from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.data import MazeData
from vd4rl_pomdp.studies.navigation.train import ProbedObjective, evaluate, make_trainer, refitted_errors


@pytest.fixture
def probed(maze_set: Path, tmp_path_factory, monkeypatch) -> ProbedObjective:
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path_factory.getbasetemp() / "maze-cache"))
    config = NavigationConfig.of("smoke", data=maze_set, out=Path(), refit_steps=20, precision="fp32")
    return make_trainer(MazeData(config), config, torch.device("cpu"))[1]


def shift_states(probed: ProbedObjective, held_out: bool) -> None:
    """Move the true states of the training or of the held-out rows."""
    split = int(probed.data.dataset.episode_start[probed.data.first_held_out])
    probed.data.states[slice(split, None) if held_out else slice(split)] += 3


def test_a_refitted_probe_knows_nothing_of_held_out_states(probed: ProbedObjective):
    probe, before = refitted_errors(probed)
    shift_states(probed, held_out=True)
    again, after = refitted_errors(probed)
    for one, other in zip(probe.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    assert before["training"] == after["training"]
    assert after["held_out"]["state"] > before["held_out"]["state"] + 100


def test_the_probe_beside_the_objective_is_measured_on_held_out_states_alone(probed: ProbedObjective):
    losses, before = evaluate(probed)
    shift_states(probed, held_out=False)
    assert evaluate(probed) == (losses, before)
    shift_states(probed, held_out=True)
    assert evaluate(probed)[1]["state"] > before["state"] + 100
