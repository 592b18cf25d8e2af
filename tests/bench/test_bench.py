from functools import partial

import pytest
import torch

from pretrain.objectives import METHODS
from vd4rl_pomdp.bench import processes, suite
from vd4rl_pomdp.bench.suite import GOALS
from vd4rl_pomdp.runs.files import flatten


def test_sections_contain_all_goals(tmp_path, monkeypatch):
    dataset, opening = suite.synthetic_set(tmp_path, 8)
    assert opening["rows"] == dataset.num_rows == 8 * suite.EPISODE_ROWS
    sections = {"opening": opening, "sampling": suite.sampling(dataset, 5)}
    monkeypatch.setattr(suite, "BATCH", 4)
    sections |= {"finetuning": suite.finetuning(dataset, 1)}
    sections |= {"methods": suite.methods(dataset, tmp_path, 1), "memories": suite.memories(dataset, tmp_path, 1)}
    sections["sharing"] = processes.sharing(0.05, rounds=1)
    measured = flatten(sections)
    assert all(value > 0 for value in measured.values())
    assert {name for name in GOALS if name.split(".")[0] in sections} <= set(measured)
    trained = {name for name, method in METHODS.items() if method.trained}
    supervised = {"supervised", "supervised+a", "supervised_picture", "integrator"}
    assert sections["methods"].keys() - {"k_30_over_k_15", "half_over_whole_resolution"} == trained - supervised


def test_rendering_benchmark_spans_episodes(monkeypatch):
    made = suite.make_env

    def short(task, render):
        env = made(task, render)
        monkeypatch.setattr(env, "_length", 2)
        return env

    monkeypatch.setattr(suite, "make_env", short)
    assert suite._render_wall(5) > 0


def test_sharing_benchmark_compares_two_runs_with_one(monkeypatch):
    speeds = {(1, ""): [100.0], (2, ""): [60.0, 50.0], (1, "300000"): [125.0]}

    def apart(function, seconds, count=1, GOMP_SPINCOUNT=""):
        return [{"updates_per_s": speed} for speed in speeds[count, GOMP_SPINCOUNT]]

    monkeypatch.setattr(processes, "apart", apart)
    assert processes.sharing(1) == {"updates_per_s": 100, "of_two_over_alone": 0.5, "over_spinning": 0.8}


def test_training_benchmarks_use_the_selected_device(monkeypatch):
    small = partial(suite.synthetic_set, episodes=1)
    named = ("sampling", "pretraining", "finetuning", "methods", "memories")
    for name in ("against_jax", "memory", "collection", "sharing", "maze_pictures", "maze_training"):
        monkeypatch.setattr(suite, name, lambda *_: {})
    for name in named:
        monkeypatch.setattr(suite, name, lambda dataset, *_: {"device": dataset.t.device.type})
    monkeypatch.setattr(suite, "synthetic_set", lambda folder, _: small(folder))
    monkeypatch.setattr(suite, "pick_device", lambda name: torch.device("meta"))
    results = suite.bench()
    assert [results[name]["device"] for name in named] == ["cpu", *["meta"] * 4]


def test_bf16_has_no_goal_where_the_cpu_has_no_kernels(capsys):
    for kernels in (True, False):
        results = {"pretraining": {"bf16_over_fp32": 0.2}, "machine": {"bf16_kernels": kernels}}
        suite.print_table(results, GOALS, "")
        assert ("missed" in capsys.readouterr().out) == kernels


def test_benchmark_against_jax(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "BATCH", 4)
    dataset, _ = suite.synthetic_set(tmp_path, 1)
    monkeypatch.setattr(suite, "apart", lambda *_: [{"ms": 1.0, "device": "cpu"}])
    monkeypatch.setattr(suite.importlib.util, "find_spec", lambda _: True)
    results = suite.against_jax(dataset, 1, (16,))
    for ours in ("units_16_fp32", "units_16_bf16"):
        assert results[f"{ours}_jax_over_ours"] == pytest.approx(1 / results[f"{ours}_ms"])
    monkeypatch.setattr(suite.importlib.util, "find_spec", lambda _: None)
    assert "pip install" in suite.against_jax(dataset, 1)["jax"]


@pytest.mark.gpu
def test_benchmark_of_a_dataset_on_a_gpu(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "BATCH", 4)
    dataset = suite.synthetic_set(tmp_path, 8)[0].to("cuda")
    assert suite.pretraining(dataset, tmp_path, 1)["device"].startswith("cuda")
    assert all(value > 0 for value in suite.finetuning(dataset, 1).values())


def test_memory_benchmark_divides_by_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "run_jobs", lambda *_: [[300, 100]])
    expected = {"frames_gib": 200 / 2**30, "peak_over_frames": 1.5, "second_process_over_frames": 0.5}
    assert processes.memory(tmp_path, 200) == expected
    monkeypatch.setattr(processes, "_STATUS", tmp_path / "none")
    assert processes.memory(tmp_path, 200) == {}


def test_maze_training_overhead(monkeypatch):
    def in_turns(rounds, *functions):
        for function in functions:
            function()
        return [1.0, 0.1, 0.05]

    monkeypatch.setattr(suite, "alternating", in_turns)
    assert suite.maze_training(torch.device("cpu")) == {
        "training_steps_per_s": 1.0,
        "training_overhead_share": pytest.approx(0.15),
    }
