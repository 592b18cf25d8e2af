import importlib
import json
import os

import pytest

from vd4rl_pomdp.bench import gpu, processes
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError, WorkerDiedError
from vd4rl_pomdp.runs.files import flatten
from vd4rl_pomdp.runs.replay import EAGER_VARIABLE


@pytest.fixture
def in_process(monkeypatch):
    """Run measurements in this process instead of subprocesses."""

    def apart(function, *arguments, count=1, **environment):
        module, _, name = function.rpartition(".")
        measures = [getattr(importlib.import_module(module), name)(*arguments) for _ in range(count)]
        return [json.loads(json.dumps(measure())) for measure in measures]

    monkeypatch.setattr(gpu, "apart", apart)
    monkeypatch.setattr(gpu, "_BETWEEN_WAITS", 1)


def test_gpu_benchmark_runs_on_a_cpu(in_process, capsys):
    main(["bench", "--gpu", "--quick", "--device", "cpu", "--json"])
    results = flatten(json.loads(capsys.readouterr().out))
    assert [name for name in results if name.endswith("failed")] == []
    assert results["device"] == "cpu"
    measured = {name for name in gpu.AIMS if name != "td3_bc.jax_over_replayed"}
    assert measured <= set(results)
    assert all(results[name] > 0 for name in measured)
    assert "jax" in results["td3_bc.jax"] or "no GPU" in results["td3_bc.jax"]


def test_failed_measurement_does_not_stop_the_others(in_process, monkeypatch, capsys):
    def fails(*_):
        raise RuntimeError("capture failed: not permitted")

    for name in ("measured", "stacked", "peer", "encoders_at_once", "evaluation"):
        monkeypatch.setattr(gpu, name, lambda *_: {"ms": 1.0})
    monkeypatch.setattr(gpu, "encoding", fails)
    monkeypatch.setattr(gpu, "stacked", fails)
    results = gpu.gpu_bench("cpu", quick=True)
    assert results["encoding"] == results["stacked"] == {"failed": "capture failed: not permitted"}
    assert results["mik+a"] == results["evaluation"] == {"ms": 1.0}
    gpu_lines = capsys.readouterr().err
    assert "RuntimeError" in gpu_lines


def test_results_survive_if_memory_cannot_be_freed(in_process, monkeypatch):
    for name in ("encoding", "measured", "stacked", "peer", "encoders_at_once", "evaluation"):
        monkeypatch.setattr(gpu, name, lambda *_: {"ms": 1.0})
    freed = []

    def free(device):
        freed.append(device)
        if len(freed) > 1:
            raise RuntimeError("captures underway")

    monkeypatch.setattr(gpu, "free", free)
    results = gpu.gpu_bench("cpu", quick=True)
    assert results["encoding"] == {"ms": 1.0}
    assert results["acro"] == {"failed": "captures underway"}


def test_eager_steps_are_never_measured_as_replayed(monkeypatch):
    seen = []
    for name in ("encoding", "peer", "evaluation", "on_features", "end_to_end", "next_step"):
        monkeypatch.setattr(gpu, name, lambda *_: {})
    for name in ("milliseconds", "encoders_at_once"):
        monkeypatch.setattr(gpu, name, lambda *_: seen.append(os.environ.get(EAGER_VARIABLE)) or 1.0)
    gpu.gpu_bench("cpu", quick=True)
    algorithms, drq_bc, methods = 4 * ["1", "0"], ["1", "0"], 2 * ["1", "0"]
    assert seen == [*algorithms, "0", *drq_bc, *methods, "0"]


def test_full_gpu_benchmark_needs_a_gpu():
    with pytest.raises(UserError, match="none is visible: on a CPU, try the code with --quick"):
        gpu.gpu_bench("cpu")


def test_process_without_result_is_reported():
    with pytest.raises(WorkerDiedError, match="without a result"):
        processes.apart("vd4rl_pomdp.bench.processes.nothing")


@pytest.mark.gpu
def test_gpu_benchmark_succeeds_on_a_gpu():
    results = gpu.gpu_bench("cuda", quick=True)
    assert [name for name in flatten(results) if name.endswith("failed")] == []
    assert results["td3_bc"]["peak_gib"] > 0
