"""Every method's step, replayed, against the same step run: on a CPU a recorder plays the CUDA graph's part."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import pretrain.train
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from pretrain.train import Trainer, make_batches, make_objective
from tests.helpers_data import write_fake_set
from tests.recording import record, replays
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.runs.device import pick_device

TRAINED = [name for name, method in METHODS.items() if method.trained]
STEPS = 12
GPU_STEPS = 200


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fake_set(tmp_path_factory.mktemp("sets") / "walker_walk" / "expert", [20, 25, 30], physics_dim=18)


def trained(folder: Path, method: str, steps: int, device: str = "cpu", **settings: object) -> tuple[Trainer, list]:
    """A trainer after some steps, and its scalars, read after the last."""
    config = PretrainConfig.of("smoke", method=method, data=folder, out=folder, corruption="patch+zero_frames")
    if "l2_states" in vars(config.options):
        config = config.altered(l2_states=0.1, **settings)
    dataset = open_dataset(folder, folder.parent / "cache")
    objective = make_objective(dataset, config).to(pick_device(device))
    dataset.to(device)
    trainer = Trainer(objective, make_batches(dataset, config, objective), config)
    logs = [trainer.update() for _ in range(steps)]
    return trainer, [{name: float(value) for name, value in row.items()} for row in logs]


def assert_same(one: tuple[Trainer, list], other: tuple[Trainer, list], tolerance: float) -> None:
    """Losses, weights, buffers, optimiser states and streams."""
    assert len(one[1]) == len(other[1])
    for row, expected in zip(one[1], other[1], strict=True):
        assert row == pytest.approx(expected, rel=tolerance, abs=tolerance)
    for name, value in one[0].objective.state_dict().items():
        torch.testing.assert_close(value, other[0].objective.state_dict()[name], rtol=tolerance, atol=tolerance)
    states = (trainer.optimiser.state_dict()["state"] for trainer, _ in (one, other))
    for mine, expected in zip(*(state.values() for state in states), strict=True):
        for name, value in mine.items():
            torch.testing.assert_close(value, expected[name], rtol=tolerance, atol=tolerance)
    assert torch.equal(one[0].batches.draws.get_state(), other[0].batches.draws.get_state())
    assert one[0].batches.state_dict().get("view") == other[0].batches.state_dict().get("view")


@pytest.mark.parametrize("method", TRAINED)
def test_a_replayed_step_is_the_one_that_is_run(
    states: Path, monkeypatch: pytest.MonkeyPatch, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    replays(monkeypatch, pretrain.train, capture=None)
    run = trained(states, method, STEPS)
    replays(monkeypatch, pretrain.train, capture=record)
    replayed = trained(states, method, STEPS)
    assert_same(replayed, run, 1e-4)
    assert "warning" not in capsys.readouterr().err
    assert replayed[0]._replay.replays
