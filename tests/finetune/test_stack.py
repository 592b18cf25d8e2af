"""Runs trained together equal single runs: on a CPU exactly; as a stack up to rounding."""

import csv
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from finetune import end_to_end, train, trainer
from finetune.algorithms import ALGORITHMS, bc, td3_bc
from finetune.config import FinetuneConfig
from finetune.features import FeatureSampler, FrozenEncoder
from finetune.histories import Histories
from finetune.train import finetune, finetune_all
from finetune.trainer import FinetuneTrainer
from pretrain.train import pretrain
from tests.helpers_data import write_fake_set
from tests.helpers_stages import run_until_cut, smoke_finetune, smoke_pretrain
from tests.recording import record, replays
from vd4rl_pomdp.cli import main, run_to_end
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.data import TransitionSampler, View, open_dataset
from vd4rl_pomdp.nn import Encoder, EncoderConfig
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.run import identity
from vd4rl_pomdp.testing.algorithms import course, farther_than_rounding

stacked = pytest.mark.usefixtures("stacks")
BRIEF = {"updates": 12, "eval_every": 6, "checkpoint_every": 4, "log_every": 3, "batch_size": 4, "eval_length": 2}


@pytest.fixture
def stacks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let runs share updates on a CPU too."""
    monkeypatch.setattr(train, "stacks_on", lambda device: True)


def same_but_for_rounding(one: Path, other: Path) -> None:
    """Assert that two folders hold the same files, records and rows, with close numbers."""
    names = [sorted(p.relative_to(run).as_posix() for p in run.rglob("*") if p.is_file()) for run in (one, other)]
    assert names[0] == names[1]
    records = [read_json(run / "config.json") for run in (one, other)]
    for run_record in records:
        run_record["config"].pop("out")
        run_record.pop("command")
    assert records[0] == records[1]
    for name in ("labels.json", "reference.json", "probe.json", "render.json"):
        if (one / name).exists() and name != "reference.json":
            assert (one / name).read_bytes() == (other / name).read_bytes()
    critics = [read_json(run / "critic.json") for run in (one, other)]
    assert [critic.pop("moved", None) for critic in critics] == [None, None], "too few rows"
    assert critics[0] == pytest.approx(critics[1], rel=1e-3, abs=1e-4)
    rows = [list(csv.DictReader((run / "episodes.csv").open())) for run in (one, other)]
    for row, theirs in zip(*rows, strict=True):
        for number in ("return", "score"):
            assert float(row.pop(number)) == pytest.approx(float(theirs.pop(number)), abs=2e-4)
        row.pop("action_error"), theirs.pop("action_error")
        assert row == theirs
    metrics = [read_metrics(run / "metrics.jsonl") for run in (one, other)]
    assert len(metrics[0]) == len(metrics[1])
    for row, theirs in zip(*metrics, strict=True):
        assert row == pytest.approx(theirs, rel=1e-4, abs=1e-5)
    states = [torch.load(max((run / "checkpoints").glob("*.pt")))["state"]["learner"] for run in (one, other)]
    close(*states)


def close(one, other) -> None:
    """Assert that nested states have the same structure, close floats, and otherwise equal values."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        one, other = list(one.values()), list(other.values())
    if isinstance(one, list | tuple):
        for mine, theirs in zip(one, other, strict=True):
            close(mine, theirs)
    elif isinstance(one, torch.Tensor):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)
    else:
        assert one == other


@pytest.mark.parametrize("algorithm", ["td3_bc", "iql"])
def test_seeds_option_writes_folders_equal_to_single_runs(encoder, data, tmp_path, monkeypatch, algorithm):
    words = ["finetune", "--preset", "smoke", "--encoder", str(encoder), "--data", str(data), "--algorithm", algorithm]
    words += ["--updates", "12", "--eval-every", "6", "--batch-size", "4", "--eval-length", "2", "--workers", "1"]
    monkeypatch.setenv("HOME", str(tmp_path))  # a shell leaves --out=~/s to the command
    for call in (["--seeds", "0,3", "--out=~/s"], ["--seed", "3", "--out", str(tmp_path / "alone")]):
        monkeypatch.setattr("sys.argv", ["vd4rl-pomdp", *words, *call])
        main()
    same_but_for_rounding(tmp_path / "s" / "seed3", tmp_path / "alone")
    for name in ("metrics.jsonl", "episodes.csv", "policy/model.safetensors"):
        assert (tmp_path / "s/seed3" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    commands = [read_json(run / "config.json")["command"] for run in (tmp_path / "s" / "seed3", tmp_path / "alone")]
    assert commands[0].replace(str(tmp_path / "s" / "seed3"), str(tmp_path / "alone")) == commands[1]
    card = read_record(encoder).pretrain.__dict__
    names = {identity(read_json(run / "config.json"), card) for run in (tmp_path / "s/seed3", tmp_path / "alone")}
    assert len(names) == 1
    weights = [(tmp_path / "s" / seed / "policy/model.safetensors").read_bytes() for seed in ("seed0", "seed3")]
    assert weights[0] != weights[1]


@stacked
def test_stacked_runs_resume_alone_or_in_another_stack(encoder, data, tmp_path, monkeypatch):
    """A stack is cut at its second checkpoint; then one member continues alone, and the stack resumes."""
    configs = {name: smoke_finetune(encoder, data, tmp_path / name, **BRIEF, seed=seed) for name, seed in SEEDS.items()}
    for config in list(configs.values())[3:]:
        finetune(config)
    # after the first member's second checkpoint
    run_until_cut(monkeypatch, 4, finetune_all, [configs["a"], configs["b"], configs["c"]])
    steps = {name: {int(p.stem) for p in (tmp_path / name / "checkpoints").glob("*.pt")} for name in ("a", "b", "c")}
    assert steps == {"a": {4}, "b": {4}, "c": {4}}
    # alone, up to the evaluation at step 6
    run_until_cut(monkeypatch, 2, finetune, configs["a"])
    made = []
    with monkeypatch.context() as patch:
        call = train.Updates.__call__
        patch.setattr(
            train.Updates,
            "__call__",
            lambda self, done: (made.append((len(self._samplers), done)), call(self, done))[1],
        )
        finetune_all([configs["c"], configs["a"], configs["b"]])
    assert made == [(2, 4), (2, 5), *((3, done) for done in range(6, 12))], "members that are behind catch up first"
    for name in ("a", "b", "c"):
        same_but_for_rounding(tmp_path / name, tmp_path / f"{name} alone")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "a").rglob("*")}
    finetune_all([configs["c"], configs["a"]])
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "a").rglob("*")} == before, "finished runs are not changed"


@pytest.mark.parametrize("together", [True, False])
def test_sigterm_saves_all_runs_after_the_step(encoder, data, tmp_path, monkeypatch, together):
    monkeypatch.setattr(train, "stacks_on", lambda device: together)
    configs = [smoke_finetune(encoder, data, tmp_path / str(seed), **BRIEF, seed=seed) for seed in range(2)]
    call, strikes = train.Updates.__call__, []

    def struck(self, done):
        if done == 4 and not strikes:
            strikes.append(os.kill(os.getpid(), signal.SIGTERM))
        return call(self, done)

    with monkeypatch.context() as patch:
        patch.setattr(train.Updates, "__call__", struck)
        with pytest.raises(interrupt.Terminated) as ended:
            finetune_all(configs)
    assert all(f"{config.out} keeps step 5" in ended.value.reason for config in configs)
    assert all((config.out / "checkpoints" / "5.pt").exists() for config in configs)


SEEDS = {"a": 0, "b": 1, "c": 2, "a alone": 0, "b alone": 1, "c alone": 2}


@stacked
def test_methods_of_equal_width_are_stacked(encoders, data, tmp_path):
    """With and without a memory, and with different datasets, seeds and views."""
    other = write_fake_set(tmp_path / "walker_walk" / "other", [9, 31])
    given = {
        "mik+a": (data, {"seed": 1, "view_seed": 7}),
        "acro": (other, {"seed": 2, "shift": 2, "eval_episodes": 2}),
    }
    for folder in ("stacked", "alone"):
        configs = [
            smoke_finetune(encoders[method], own, tmp_path / folder / method, **(BRIEF | more))
            for method, (own, more) in given.items()
        ]
        for some in [configs] if folder == "stacked" else [[config] for config in configs]:
            finetune_all(some)
    for method in given:
        same_but_for_rounding(tmp_path / "stacked" / method, tmp_path / "alone" / method)


@stacked
def test_stack_with_one_view_seed_encodes_once(encoder, data, tmp_path, monkeypatch):
    encode, encoded = FrozenEncoder.frames, []
    monkeypatch.setattr(FrozenEncoder, "frames", lambda *words: (encoded.append(words), encode(*words))[1])
    own = [{"seed": seed, "view_seed": 8} | BRIEF for seed in (0, 1)]
    finetune_all([smoke_finetune(encoder, data, tmp_path / f"{number}", **own[number]) for number in (0, 1)])
    assert len(encoded) == 3, "one call per episode"
    cut = [smoke_finetune(encoder, data, tmp_path / f"cut{number}", **own[number]) for number in (0, 1)]
    run_until_cut(monkeypatch, 2, finetune_all, cut)
    assert all((tmp_path / f"cut{number}" / "features.npy").exists() for number in (0, 1)), "each resumes by itself"
    finetune(smoke_finetune(encoder, data, tmp_path / "alone", **own[1]))
    same_but_for_rounding(tmp_path / "1", tmp_path / "alone")


@pytest.mark.parametrize("together", [True, False])
def test_diverged_run_does_not_stop_the_others(encoder, data, tmp_path, capsys, monkeypatch, together):
    monkeypatch.setattr(train, "stacks_on", lambda device: together)
    configs = [smoke_finetune(encoder, data, tmp_path / str(seed), **BRIEF, seed=seed) for seed in range(3)]
    build = FinetuneTrainer.build

    def broken(self):
        build(self)
        if self.config.seed == 1:
            self.sampler.data[:, -2] = float("inf")

    with monkeypatch.context() as patch:
        patch.setattr(FinetuneTrainer, "build", broken)
        with pytest.raises(FloatingPointError, match=rf"{tmp_path / '1'}: critic_loss is .* in the row of step 3"):
            finetune_all(configs)
    assert "the other runs continue" in capsys.readouterr().err
    assert read_json(tmp_path / "1" / "diverged.json")["step"] == 3
    assert not (tmp_path / "1" / "timing.json").exists()
    finetune(smoke_finetune(encoder, data, tmp_path / "alone", **BRIEF, seed=2))
    same_but_for_rounding(tmp_path / "2", tmp_path / "alone")


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("", "--batch-size 8", "cannot be stacked: --batch-size is 4 and 8"),
        ("", "--algorithm iql", "cannot be stacked: --algorithm is td3_bc and iql"),
        ("", "--alpha 5", "cannot be stacked: --alpha is 2.5 and 5.0"),
        ("", "--encoder {state} --data {states}", "cannot be stacked: the representations' width is 32 and 18"),
        ("", "--encoder {drq_bc}", "b: drq_bc also trains its encoder and cannot be stacked"),
        ("--views 0", "--views 0", "a: --views 0 encodes every batch and cannot be stacked"),
        ("", "--out {out}/a", "a is given twice: a folder holds one run"),
        ("--seeds 0,0", "", "--seeds is '0,0': give different whole numbers"),
        ("--seeds 0,1 --seed 3", "", "--seed and --seeds are both given"),
    ],
)
def test_incompatible_stacks_are_rejected(encoders, data, tmp_path, first, second, message):
    out = tmp_path / "out"
    given = f"--preset smoke --data {data} --encoder {encoders['mik+a']} --batch-size 4 --updates 12 --eval-every 6"
    words = f"finetune {given} --out {out}/a {first} + {given} --out {out}/b {second}"
    end = run_to_end(words.format(out=out, **encoders).split())
    assert end.code == 2
    assert message in end.line
    assert "\n" not in end.line
    assert not out.exists()


@pytest.fixture(scope="module")
def encoders(data, encoder, tmp_path_factory) -> dict[str, Path]:
    """Encoders by method, and a dataset with states."""
    folder = tmp_path_factory.mktemp("encoders")
    states = write_fake_set(folder / "walker_walk" / "expert", [20, 25, 30], physics_dim=18)
    made = {"mik+a": encoder, "states": states}
    for method in ("state", "drq_bc", "bc", "acro"):
        given = states if method == "state" else data
        made[method] = pretrain(smoke_pretrain(given, folder / method, method=method)).path / "encoder"
    return made


def made(name: str, data: Path, seed: int, device: str = "cpu") -> SimpleNamespace:
    """An algorithm and its sampler, as in a run; learning rates are tensors, which a replayed step reads."""
    torch.manual_seed(seed)
    dataset = open_dataset(data).to(device)
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(2, dataset.num_rows, 5, generator=generator).half().to(device)
    config = FinetuneConfig.of("smoke", algorithm=name, learning_rate=1e-3, updates=40)
    policy = Policy(5, dataset.action_dim, 16).to(device)
    policy.standardise.fit(features)
    streams = [RandomStream(torch.Generator().manual_seed(10 * seed + n), device) for n in range(2)]
    algorithm = ALGORITHMS[name](policy, config.options, config.learning_rate, config.updates, streams[0])
    sampler = FeatureSampler(Histories(dataset, NO_OPTIONS, 2, 0), features, 16, 2, 0.9, streams[1])
    return SimpleNamespace(algorithm=algorithm, sampler=sampler, config=config)


def course_of(runs: list[SimpleNamespace], updates: int) -> list[dict[str, torch.Tensor]]:
    """Logs and final state of each run; the logs are read after the last update."""
    step = train.Updates([run.algorithm for run in runs], [run.sampler for run in runs], runs[0].config)
    logs = [step(made) for made in range(updates)]
    found = []
    for number, run in enumerate(runs):
        step.settle(number)
        found.append(course(run.algorithm, [row[number] for row in logs]) | {"batches": run.sampler.draws.get_state()})
    return found


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_replayed_updates_equal_eager_updates(data, monkeypatch, capsys, name, runs):
    """Covers noise, batches, the delayed actor, complete schedules, and the scalars of every update."""
    monkeypatch.setattr("vd4rl_pomdp.core.streams.BLOCK", 32)
    modules = [sys.modules[kind.__module__] for kind in ALGORITHMS[name].__mro__]
    found = []
    for capture in (None, record):
        replays(monkeypatch, train, *modules, capture=capture)
        members = [made(name, data, seed) for seed in range(runs)]
        found.append(course_of(members, 60))
    assert not capsys.readouterr().err, "capture did not fall back"
    for one, other in zip(*found, strict=True):
        assert one.keys() == other.keys()
        for key, value in one.items():
            torch.testing.assert_close(other[key], value, rtol=1e-4, atol=1e-6, msg=lambda m, key=key: f"{key}: {m}")
    parts = [run.algorithm.parts() for run in members]
    rates = [float((own.get("policy_optimiser") or own["optimiser"]).param_groups[0]["lr"]) for own in parts]
    assert rates == pytest.approx([0.0 if name == "iql" else 1e-3] * runs, abs=1e-9)


@pytest.mark.parametrize("method", ["mik+a", "acro", "drq_bc", "bc"])
def test_replayed_runs_equal_eager_runs(encoders, data, tmp_path, monkeypatch, capsys, method):
    """On cached features, on exact batches, and end to end; interrupted and resumed."""
    changes = BRIEF | {"updates": 20, "eval_every": 10, "views": 0 if method == "acro" else 1}
    monkeypatch.setattr(trainer, "STANDARDISED_BY", 16)
    for folder, capture in (("run", None), ("replayed", record)):
        replays(monkeypatch, train, end_to_end, td3_bc, bc, capture=capture)
        config = smoke_finetune(encoders[method], data, tmp_path / folder, **changes)
        run_until_cut(monkeypatch, 4, finetune, config)
        finetune(config)
    assert "warning" not in capsys.readouterr().err
    same_but_for_rounding(tmp_path / "run", tmp_path / "replayed")


def test_exact_batches_of_a_memory_are_never_captured(encoders, data, tmp_path, monkeypatch, capsys):
    """They read values, so a capture would fail; one warning says why the updates are slower."""
    captured = []
    monkeypatch.setattr(trainer, "STANDARDISED_BY", 16)
    replays(monkeypatch, train, capture=lambda function: captured.append(function) or record(function))
    changes = BRIEF | {"updates": 8, "eval_episodes": 0, "views": 0}
    finetune(smoke_finetune(encoders["mik+a"], data, tmp_path / "run", **changes))
    assert captured == []
    assert capsys.readouterr().err.count("which is slower: --views 0 reads the lengths of histories") == 1


def along(name: str, data: Path, precision: str) -> SimpleNamespace:
    """An algorithm that also trains its encoder, on a GPU."""
    torch.manual_seed(0)
    dataset = open_dataset(data).to("cuda")
    config = FinetuneConfig.of("smoke", algorithm=name, learning_rate=1e-3, updates=40, precision=precision)
    encoder = Encoder(EncoderConfig(dataset.action_dim, feature_dim=16)).to("cuda")
    policy = Policy(encoder.dim, dataset.action_dim, 16).to("cuda")
    streams = [RandomStream(torch.Generator().manual_seed(number), "cuda") for number in range(2)]
    inner = ALGORITHMS[name](policy, config.options, config.learning_rate, config.updates, streams[0])
    sampler = TransitionSampler(View(dataset, "patch+zero_frames", 4), 16, streams[1], 2, 0.9)
    algorithm = end_to_end.EndToEnd(inner, encoder, config)
    return SimpleNamespace(algorithm=algorithm, sampler=sampler, config=config)


GPU_UPDATES = 200


def within_rounding(monkeypatch, capsys, make: Callable[[int], SimpleNamespace], runs: int) -> None:
    """Captured and eager updates differ from single ones only by rounding."""
    found = {}
    for eager in ("0", "1"):
        monkeypatch.setenv("VD4RL_POMDP_EAGER", eager)
        found[eager] = course_of([make(seed) for seed in range(runs)], GPU_UPDATES)
    assert "warning: " not in capsys.readouterr().err
    for seed in range(runs):

        def single(change: Any, seed: int = seed) -> dict[str, torch.Tensor]:
            run = make(seed)
            change(getattr(run.algorithm, "algorithm", run.algorithm))
            return course_of([run], GPU_UPDATES)[0]

        for courses in found.values():
            assert farther_than_rounding(courses[seed], single) == []
        assert torch.equal(found["0"][seed]["batches"], found["1"][seed]["batches"])


@pytest.mark.gpu
@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_gpu_captured_and_stacked_updates_match_single_ones(data, monkeypatch, capsys, name, runs):
    within_rounding(monkeypatch, capsys, lambda seed: made(name, data, seed, "cuda"), runs)


@pytest.mark.gpu
@pytest.mark.usefixtures("compiled_anew")
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("name", ["drqv2_bc", "bc"])
def test_gpu_captured_updates_train_the_encoder(data, monkeypatch, capsys, name, precision):
    within_rounding(monkeypatch, capsys, lambda seed: along(name, data, precision), 1)
