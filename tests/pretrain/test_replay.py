"""Replayed against eager steps of every method; on a CPU a recorder stands in for the CUDA graph."""

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
from vd4rl_pomdp.core.hardware import pick_device
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.runs.checkpoint import pack, unpack
from vd4rl_pomdp.runs.replay import EAGER_VARIABLE

GPU_STEPS = 200
TRAINED = [name for name, method in METHODS.items() if method.trained]
STEPS = 12


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fake_set(tmp_path_factory.mktemp("sets") / "walker_walk" / "expert", [20, 25, 30], physics_dim=18)


def trained(folder: Path, method: str, steps: int, device: str = "cpu", noise: float = 0.0) -> tuple[Trainer, list]:
    """A trainer after `steps`, and its scalars, read at the end; `noise` perturbs its initial weights."""
    config = PretrainConfig.of("smoke", method=method, data=folder, out=folder, corruption="patch+zero_frames")
    config = config.with_known(l2_states=0.1)
    dataset = open_dataset(folder, folder.parent / "cache")
    objective = make_objective(dataset, config).to(pick_device(device))
    dataset.to(device)
    generator = torch.Generator().manual_seed(0)
    for weights in objective.parameters():
        weights.data *= 1 + noise * torch.randn(weights.shape, generator=generator).to(device)
    trainer = Trainer(objective, make_batches(dataset, config, objective), config)
    logs = [trainer.update() for _ in range(steps)]
    return trainer, [{name: float(value) for name, value in row.items()} for row in logs]


def assert_same(one: tuple[Trainer, list], other: tuple[Trainer, list], tolerance: float) -> None:
    """Assert equal losses, weights, buffers, optimiser states and streams."""
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
def test_replayed_pretraining_equals_eager_pretraining(
    states: Path, monkeypatch: pytest.MonkeyPatch, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    replays(monkeypatch, pretrain.train, capture=None)
    run = trained(states, method, STEPS)
    replays(monkeypatch, pretrain.train, capture=record)
    replayed = trained(states, method, STEPS)
    assert_same(replayed, run, 1e-4)
    assert "warning" not in capsys.readouterr().err
    assert replayed[0]._replay.replays


@pytest.mark.parametrize("method", ["mik+a", "curl", "driml"])
def test_replayed_pretraining_resumes(states: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """From the state of a replayed and of an eager training."""
    replays(monkeypatch, pretrain.train, capture=record)
    whole = trained(states, method, STEPS)
    for capture in (record, None):
        replays(monkeypatch, pretrain.train, capture=capture)
        cut = trained(states, method, STEPS // 2)
        replays(monkeypatch, pretrain.train, capture=record)
        resumed = trained(states, method, 0)
        resumed[0].restore(unpack(pack(cut[0].state())))
        logs = [resumed[0].update() for _ in range(STEPS - STEPS // 2)]
        logs = [{name: float(value) for name, value in row.items()} for row in logs]
        assert_same((resumed[0], cut[1] + logs), whole, 1e-4)


def distance(one: tuple[Trainer, list], other: tuple[Trainer, list]) -> list[float]:
    """Norms of the differences of weights, optimiser states and losses."""

    def flat(trainer: Trainer, logs: list) -> list[torch.Tensor]:
        states = [x for s in trainer.optimiser.state.values() for name, x in s.items() if name != "step"]
        losses = torch.tensor([row["loss"] for row in logs])
        parts = (list(trainer.objective.parameters()), states)
        return [*(torch.cat([x.detach().cpu().flatten() for x in part]) for part in parts), losses]

    return [float((a - b).norm()) for a, b in zip(flat(*one), flat(*other), strict=True)]


@pytest.mark.gpu
@pytest.mark.usefixtures("compiled_anew")
@pytest.mark.parametrize("method", TRAINED)
def test_cuda_graph_deviates_only_by_rounding(
    states: Path, monkeypatch: pytest.MonkeyPatch, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The tolerance comes from two eager runs whose initial weights differ in the last bits."""
    with monkeypatch.context() as patch:
        patch.setenv(EAGER_VARIABLE, "1")
        run = trained(states, method, GPU_STEPS, "cuda")
        other = trained(states, method, GPU_STEPS, "cuda", noise=2.0**-24)
    replayed = trained(states, method, GPU_STEPS, "cuda")
    for found, allowed in zip(distance(replayed, run), distance(other, run), strict=True):
        assert found <= 4 * allowed
    assert torch.equal(replayed[0].batches.draws.get_state(), run[0].batches.draws.get_state())
    assert replayed[0].batches.state_dict().get("view") == run[0].batches.state_dict().get("view")
    assert "warning" not in capsys.readouterr().err
    assert replayed[0]._replay.replays
