"""`vd4rl-pomdp bench --gpu`: the `paper` preset on one GPU, with CUDA graphs and eager, next to JAX, in one run.

Times are medians over blocks of many steps between synchronisations. Warm-up steps, in which libraries choose kernels
and steps are captured, are not counted.
"""

from __future__ import annotations

import gc
import importlib.util
import os
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from finetune.config import FinetuneConfig
from finetune.evaluation import evaluate, jobs_of
from finetune.features import STAGE, FrozenEncoder, encode_views
from finetune.histories import Histories
from pretrain.config import PretrainConfig
from vd4rl_pomdp.bench.processes import JAX_MISSING, apart, make_trainer
from vd4rl_pomdp.bench.suite import next_update, on_features, repeated, seconds_of, synthetic_set
from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.hardware import pick_device
from vd4rl_pomdp.core.options import NO_OPTIONS, flat
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, open_dataset
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig
from vd4rl_pomdp.nn.encoder_folder import save_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.provenance import git_commit, machine, versions
from vd4rl_pomdp.runs.replay import EAGER_VARIABLE

AIMS: dict[str, tuple[str, float]] = {
    "td3_bc.replayed_ms": ("<=", 0.55),
    "td3_bc.jax_over_replayed": (">=", 1.0),
    "stacked.all_ms": ("<=", 1.0),
    "mik+a.replayed_ms": ("<=", 3.3),
    "acro.replayed_ms": ("<=", 2.6),
    "encoders_at_once.each_ms": ("<=", 2.5),
    "iql.eager_over_replayed": (">=", 9.0),
    "bc.eager_over_replayed": (">=", 9.0),
    "drqv2_bc.eager_over_replayed": (">=", 9.0),
    "drq_bc.eager_over_replayed": (">=", 3.0),
    "encoding.seconds": ("<=", 15.0),
    "evaluation.seconds": ("<=", 60.0),
}
"""Goals for one H200; evaluation on 16 cores with EGL."""
CORRUPTION = "patch+zero_frames"
_BETWEEN_WAITS = 8
_SETTLED = 12
"""Warm-up steps; more than run before a step is captured."""


@dataclass(frozen=True)
class Size:
    """Sizes of the measurements; everything else follows the preset."""

    episodes: int
    hidden_dim: int
    batch_size: int
    windows: int
    """Pretraining batch size."""
    views: int
    blocks: int
    updates: int
    """Policy updates per block."""
    steps: int
    """Encoder steps per block."""
    played: int
    """Evaluation episodes."""
    decisions: int
    """Decisions per evaluation episode."""
    runs: int
    """Stacked policies, and concurrent encoders."""
    frame_encoder: str = "drq"
    window: int = 32
    """Window length in rows."""


PAPER = Size(100, 1024, 256, 16, 4, 5, 512, 64, 100, 500, 5)  # at least as many updates as are drawn at once
TINY = Size(1, 16, 8, 2, 1, 1, 2, 1, 1, 3, 2, "nature", 16)
"""Tests the code on any machine in seconds; the numbers mean nothing."""


def gpu_bench(device_name: str = "auto", quick: bool = False) -> dict[str, Any]:
    """All times, ratios and peak memory, with machine, commit and versions; UserError without a GPU, unless `quick`,
    whose tiny sizes only test the code."""
    device = pick_device(device_name)
    if device.type != "cuda" and not quick:
        raise UserError("bench --gpu measures a GPU, and none is visible: on a CPU, try the code with --quick")
    torch.manual_seed(0)
    size = TINY if quick else PAPER
    results: dict[str, Any] = {"device": device.type}

    def add(name: str, measure: Callable[[], dict[str, Any]]) -> None:
        try:
            free(device)
            results[name] = results.get(name, {}) | measure()
        except Exception as error:  # the remaining measurements are still useful
            traceback.print_exc()
            results[name] = results.get(name, {}) | {"failed": first_line(error)}

    # 0: else a failed capture would be measured as replayed
    with tempfile.TemporaryDirectory() as name, patch.dict(os.environ, {EAGER_VARIABLE: "0"}):
        folder = Path(name)
        dataset = synthetic_set(folder, size.episodes)[0].to(device)
        encoder = make_trainer(dataset, pretraining(folder, "mik+a", size)).objective.encoder.eval()
        features = torch.randn(size.views, dataset.num_rows, encoder.dim, device=device).half()
        add("encoding", lambda: encoding(dataset, encoder, folder, size))
        for algorithm in ("td3_bc", "iql", "bc", "drqv2_bc"):
            update = partial(on_features, finetuning(algorithm, size), dataset, features)
            add(algorithm, partial(measured, update, device, size.updates, size.blocks))
        add("td3_bc", lambda: peer(dataset, features, size, results["td3_bc"]["replayed_ms"]))
        add("stacked", lambda: stacked(dataset, features, size))
        add("drq_bc", lambda: measured(partial(end_to_end, dataset, size), device, size.steps, size.blocks))
        for method in ("mik+a", "acro"):
            train = partial(next_step, dataset, pretraining(folder, method, size))
            add(method, partial(measured, train, device, size.steps, size.blocks))
        add("encoders_at_once", lambda: encoders_at_once(dataset, folder, size))
        add("evaluation", lambda: evaluation(encoder, dataset, folder, size))
    return results | {"machine": machine(device_name), "commit": git_commit(), "versions": versions()}


def measured(make: Callable[[], Callable[[], Any]], device: torch.device, steps: int, blocks: int) -> dict[str, float]:
    """Milliseconds per step, eager and replayed, and peak memory when replayed."""
    with patch.dict(os.environ, {EAGER_VARIABLE: "1"}):  # disables CUDA graphs
        slow = milliseconds(make(), device, max(1, steps // 4), max(1, blocks // 2))
    free(device)
    fast = milliseconds(make(), device, steps, blocks)
    return {"eager_ms": slow, "replayed_ms": fast, "eager_over_replayed": slow / fast} | peak(device)


def milliseconds(step: Callable[[], Any], device: torch.device, steps: int, blocks: int) -> float:
    """Median over blocks of the mean time of a step."""
    for _ in range(_SETTLED if device.type == "cuda" else 1):
        step()
    return seconds_of(repeated(steps, step), blocks) / steps * 1e3


def wait(device: torch.device) -> None:
    """Synchronise a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def free(device: torch.device) -> None:
    """Free cached memory and reset the peak."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def peak(device: torch.device) -> dict[str, float]:
    """Peak GPU memory of tensors since `free`, including the dataset."""
    return {"peak_gib": torch.cuda.max_memory_allocated(device) / 2**30} if device.type == "cuda" else {}


def pretraining(folder: Path, method: str, size: Size) -> PretrainConfig:
    """Pretraining config: the `paper` preset in bf16."""
    return PretrainConfig.of(
        "paper", data=folder, out=folder, method=method, corruption=CORRUPTION, precision="bf16",
        frame_encoder=size.frame_encoder, batch_size=size.windows, window=size.window,
        max_k=min(15, size.window - 1),
    )  # fmt: skip


def next_step(dataset: Dataset, config: PretrainConfig) -> Callable[[], Any]:
    """A function that makes one pretraining step."""
    return make_trainer(dataset, config).update


def encoding(dataset: Dataset, encoder: Encoder, folder: Path, size: Size) -> dict[str, float]:
    """Seconds to encode all views of a dataset."""
    device, config = dataset.t.device, FinetuneConfig.of("paper", precision="bf16")
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.of(CORRUPTION), config.shift, config.precision, 0)
    histories = Histories(dataset, NO_OPTIONS, 3, 0)
    start = time.perf_counter()
    encode_views(frozen, histories, size.views, folder / "features.npy", "bench")
    wait(device)
    seconds = time.perf_counter() - start
    return {"views": size.views, "episodes": dataset.num_episodes, "seconds": seconds} | peak(device)


def stacked(dataset: Dataset, features: torch.Tensor, size: Size) -> dict[str, float]:
    """Milliseconds per update of several stacked TD3+BC runs: of the stack, and per run."""
    update = on_features(finetuning("td3_bc", size), dataset, features, size.runs)
    ms = milliseconds(update, features.device, size.updates, size.blocks)
    return {"runs": size.runs, "all_ms": ms, "a_seed_ms": ms / size.runs} | peak(features.device)


def end_to_end(dataset: Dataset, size: Size) -> Callable[[], object]:
    """A function that makes one update of `drq_bc`, including its encoder."""
    config = finetuning("drqv2_bc", size)
    encoder = Encoder(EncoderConfig(dataset.action_dim)).to(dataset.t.device)
    view = View(dataset, CorruptionConfig.of(CORRUPTION), config.shift, 0, STAGE)
    batches = partial(TransitionSampler, view, config.batch_size, n_step=3, gamma=0.99)
    return next_update(config, dataset, encoder.dim, batches, 1, encoder)


def finetuning(algorithm: str, size: Size) -> FinetuneConfig:
    """Fine-tuning config: the `paper` preset with a bf16 encoder."""
    return FinetuneConfig.of(
        "paper", algorithm=algorithm, precision="bf16", hidden_dim=size.hidden_dim, batch_size=size.batch_size
    )


def encoders_at_once(dataset: Dataset, folder: Path, size: Size) -> dict[str, float]:
    """Milliseconds per step of concurrent pretrainings: time of one step of all, divided by their number.

    Measured in one process with a CUDA stream each, and with a process each; the faster counts.
    """
    device = dataset.t.device
    streams = [torch.cuda.Stream(device) if device.type == "cuda" else None for _ in range(size.runs)]
    updates = [make_trainer(dataset, pretraining(folder, "mik+a", size)).update for _ in range(size.runs)]
    wait(device)  # they were initialised on another stream

    def step() -> None:
        for stream, update in zip(streams, updates, strict=True):
            with torch.cuda.stream(stream):
                update()

    in_one = milliseconds(step, device, size.steps, size.blocks) / size.runs
    measured = {"at_once": size.runs, "on_streams_ms": in_one} | peak(device)
    updates.clear()
    free(device)
    given = str(folder), str(device), asdict(size), 4.0 if size is PAPER else 0.1
    answers = apart(f"{__name__}.pretraining_steps", *given, count=size.runs)
    in_processes = 1e3 / sum(answer["steps_per_s"] for answer in answers)
    return measured | {"in_processes_ms": in_processes, "each_ms": min(in_one, in_processes)}


def pretraining_steps(folder: str, device: str, size: dict[str, Any], seconds: float) -> Callable[[], dict[str, Any]]:
    """Pretrain `mik+a` with the `paper` preset in bf16 for this many seconds."""
    place = torch.device(device)
    dataset = open_dataset(Path(folder) / "set", Path(folder) / "cache").to(place)
    trainer = make_trainer(dataset, pretraining(Path(folder), "mik+a", Size(**size)))
    milliseconds(trainer.update, place, 1, 1)  # warm-up

    def measure() -> dict[str, float]:
        start, steps = time.perf_counter(), 0
        while (spent := time.perf_counter() - start) < seconds:
            for _ in range(_BETWEEN_WAITS):
                trainer.update()
            wait(place)
            steps += _BETWEEN_WAITS
        return {"steps_per_s": steps / spent}

    return measure


def peer(dataset: Dataset, features: torch.Tensor, size: Size, replayed_ms: float) -> dict[str, Any]:
    """The same update in JAX; a ratio only if JAX sees this GPU."""
    if importlib.util.find_spec("optax") is None or importlib.util.find_spec("jax") is None:
        return {"jax": JAX_MISSING}
    shape = {"hidden_dim": size.hidden_dim, "batch_size": size.batch_size, "dim": features.shape[-1]}
    shape |= {"action_dim": dataset.action_dim, "views": len(features), "rows": dataset.num_rows}
    given = "vd4rl_pomdp.bench.processes.jax_updates", shape, size.updates, size.blocks
    # by default JAX preallocates three quarters of the GPU's memory
    ((exact,), (tf32,)) = (apart(*given, words, XLA_PYTHON_CLIENT_PREALLOCATE="false") for words in (False, True))
    if exact["device"] == "cpu":  # a device kind in JAX
        return {"jax": f"sees no GPU: {exact['ms']:.3g} ms on the CPU"}
    # both in TF32, the update precision of `paper`
    return {"jax_ms": exact["ms"], "jax_over_replayed": tf32["ms"] / replayed_ms, "jax_tf32_ms": tf32["ms"]}


def evaluation(encoder: Encoder, dataset: Dataset, folder: Path, size: Size) -> dict[str, Any]:
    """Seconds for an evaluation on all cores."""
    corruption = CorruptionConfig.of(CORRUPTION)
    card = EncoderCard("mik+a", "walker_walk", "bench", flat(corruption), 0, 0, "paper")
    save_encoder(folder / "encoder", encoder, card)
    Policy(encoder.dim, dataset.action_dim, size.hidden_dim).save(folder / "policy")
    jobs = jobs_of(folder, TASKS.named("walker_walk"), [corruption], size.played, size.decisions)
    start = time.perf_counter()
    evaluate(jobs, 0)
    return {"episodes": size.played, "cores": os.cpu_count(), "seconds": time.perf_counter() - start}
