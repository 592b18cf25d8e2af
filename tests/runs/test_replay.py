"""Replayed against eager steps on a CPU, where a recorder stands in for the CUDA graph."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.recording import record
from vd4rl_pomdp.core.streams import BLOCK, RandomStream
from vd4rl_pomdp.nn.adam import Adam, set_learning_rate
from vd4rl_pomdp.nn.heads import move_target
from vd4rl_pomdp.runs import replay as module
from vd4rl_pomdp.runs.replay import EAGER_VARIABLE, Replay

CPU = torch.device("cpu")


class Regression:
    """A small training: sampled batches, noise, a target network, and an extra update in every other step."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.x, self.y = torch.randn(100, 5), torch.randn(100, 1)
        self.net, self.target = nn.Linear(5, 1), nn.Linear(5, 1)
        self.optimiser = Adam(self.net.parameters(), 1e-2, fused=True)
        self.optimiser.param_groups[0]["lr"] = torch.tensor(1e-2)
        self.draws = RandomStream(torch.Generator().manual_seed(3))
        self.done = torch.zeros((), dtype=torch.int64)

    def step(self, turn: int) -> dict[str, Tensor]:
        index, noise = self.draws.integers(100, 8), self.draws.normal(8, 5)
        loss = (self.net(self.x[index] + 0.1 * noise) - self.y[index]).square().mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        set_learning_rate(self.optimiser, 1e-2 * (1 - self.done / 1000))
        self.optimiser.step()
        logs = {"loss": loss.detach(), "index": index[0], "noise": noise[0, 0]}
        if turn == 1:
            move_target(self.target, self.net, 0.1)
            logs["shift"] = self.draws.uniform(1)[0]
        self.done += 1
        return logs

    def state(self) -> list[Tensor]:
        state = [*self.net.parameters(), *self.target.parameters(), self.done]
        return [*state, *(x for s in self.optimiser.state.values() for x in s.values()), self.draws.get_state()]


def train(made: Regression, steps: int, capture: Any = None, begun: int = 0) -> list[dict[str, float]]:
    """The scalars of every step, read after the last step."""
    replay = Replay(made.step, CPU, [made.draws], 2, [made], capture)
    logs = [replay(step % 2) for step in range(begun, begun + steps)]
    return [{name: float(value) for name, value in row.items()} for row in logs]


def test_replayed_steps_equal_eager_steps() -> None:
    """Batches, noise, learning rate, targets and the second turn, over more than one block of draws."""
    run, replayed = Regression(), Regression()
    expected, got = train(run, BLOCK + 30), train(replayed, BLOCK + 30, record)
    assert [row.keys() for row in got] == [row.keys() for row in expected]
    for row, other in zip(got, expected, strict=True):
        assert row == pytest.approx(other, rel=1e-4, abs=1e-6)
    for one, other in zip(replayed.state(), run.state(), strict=True):
        torch.testing.assert_close(one, other)


def test_state_does_not_depend_on_prefetched_draws() -> None:
    """Replayed and eager training save the same state, and either resumes from it."""
    run, replayed = Regression(), Regression()
    train(run, 41)
    train(replayed, 41, record)
    assert torch.equal(run.draws.get_state(), replayed.draws.get_state())
    ahead = Regression()
    train(ahead, 20, record)
    replay = Replay(ahead.step, CPU, [ahead.draws], 2, [ahead], record)
    ahead.draws.one_by_one()
    ahead.draws.set_state(run.draws.get_state())
    for step in range(20):
        logs = replay((41 + step) % 2)
        assert int(run.draws.integers(100, 8)[0]) == int(logs["index"])
        run.draws.normal(8, 5)
        if (41 + step) % 2:
            run.draws.uniform(1)


class Reads(Regression):
    def step(self, turn: int) -> dict[str, Tensor]:
        logs = super().step(turn)
        if logs["loss"] < -1:  # control flow that depends on a value
            raise AssertionError
        return logs


class Counts(Regression):
    count = 0

    def step(self, turn: int) -> dict[str, Tensor]:
        self.count += 1
        return super().step(turn) | {"count": torch.tensor(float(self.count))}


class Rebinds(Regression):
    mean = torch.zeros(())

    def step(self, turn: int) -> dict[str, Tensor]:
        logs = super().step(turn)
        self.mean = 0.9 * self.mean + 0.1 * logs["loss"].detach()
        return logs | {"mean": self.mean}


class Draws(Regression):
    def step(self, turn: int) -> dict[str, Tensor]:
        return super().step(turn) | {"own": torch.randn(1)[0]}


@pytest.mark.parametrize(
    ("made", "reason"), [(Reads, "item|local_scalar"), (Counts, "count"), (Rebinds, "mean"), (Draws, "randn")]
)
def test_steps_that_cannot_be_captured_run_eagerly_with_one_warning(
    made: type[Regression], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The numbers equal those without capture."""
    torch.manual_seed(0)
    expected = train(made(), 40)
    torch.manual_seed(0)
    got = train(made(), 40, record)
    for row, other in zip(got, expected, strict=True):
        row.pop("own", None)
        other.pop("own", None)
        assert row == pytest.approx(other, rel=1e-4)
    stderr = capsys.readouterr().err
    assert stderr.count("warning") == 1
    assert [word for word in reason.split("|") if word in stderr]


def test_failed_capture_raises_where_eager_steps_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(EAGER_VARIABLE, "0")
    with pytest.raises(RuntimeError, match="reads a value"):
        train(Reads(), 40, record)


@pytest.mark.parametrize("known", [True, False])
def test_failed_capture_ends_its_pool_and_names_the_first_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], known: bool
) -> None:
    """`known`: whether this PyTorch has the private function that ends the pool."""
    underway, ended = list[bool](), list[tuple]()

    @contextmanager
    def graph(*_: Any, **__: Any) -> Iterator[None]:
        underway.append(True)
        try:
            yield
        finally:
            underway.clear()
            raise RuntimeError("the capture is invalid")

    def step(turn: int) -> dict[str, Tensor]:
        if underway:
            raise ValueError("a value is read")
        return {"loss": torch.zeros(())}

    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 7))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", SimpleNamespace)
    monkeypatch.setattr(torch._C, "_cuda_endAllocateToPool", lambda *given: ended.append(given), raising=False)
    if not known:
        monkeypatch.delattr(torch._C, "_cuda_endAllocateToPool")
    stream: Any = SimpleNamespace(device=torch.device("cuda:1"))
    replay = Replay(step, CPU, capture=module._cuda_graphs(stream))
    for _ in range(5):
        replay(0)
    assert not replay.replays
    assert ended == [(1, (0, 7))] * known
    assert capsys.readouterr().err.endswith("which is slower: a value is read\n")


@pytest.mark.gpu
def test_gpu_captures_after_a_failed_capture(capsys: pytest.CaptureFixture[str]) -> None:
    x = torch.ones((), device="cuda")
    failed = Replay(lambda turn: {"loss": x * x.item()}, x.device)
    for _ in range(5):
        failed(0)
    assert not failed.replays
    assert "warning" in capsys.readouterr().err
    torch.cuda.empty_cache()
    replay = Replay(lambda turn: {"loss": x + 1}, x.device)
    assert [float(replay(0)["loss"]) for _ in range(5)] == [2.0] * 5
    assert replay.replays
    assert "warning" not in capsys.readouterr().err


def test_eager_draws_do_not_accumulate_memory() -> None:
    """CPU training makes a million draws."""
    draws = RandomStream(torch.Generator().manual_seed(0))
    draws.integers(10, 4)
    tracemalloc.start()
    for _ in range(500):
        draws.normal(4)
    left, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert left < 20_000
