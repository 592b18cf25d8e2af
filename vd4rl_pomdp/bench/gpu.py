"""`vd4rl-pomdp bench --gpu`: what a card makes of the `paper` preset, replayed and eager, beside the peer, in one run.

Times are medians over blocks of many steps, from one synchronisation to the next; the steps before them, in which
libraries choose their kernels and steps are captured, are not counted.
"""

from __future__ import annotations

import gc
import importlib.util
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from finetune.algorithms import ALGORITHMS
from finetune.algorithms.algorithm import Algorithm
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.features import STAGE, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories
from pretrain.config import PretrainConfig
from vd4rl_pomdp.bench.measures import synthetic_set
from vd4rl_pomdp.bench.processes import Worker, at_once, make_trainer
from vd4rl_pomdp.core.errors import UserError, WorkerDiedError, first_line
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.streams import random_stream
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig
from vd4rl_pomdp.nn.encoder_folder import save_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.provenance import git_commit, machine, versions
from vd4rl_pomdp.runs.replay import EAGER_VARIABLE

AIMS: dict[str, tuple[str, float]] = {
    "td3_bc.replayed_ms": ("<=", 0.55),
    "td3_bc.jax_over_replayed": (">=", 1.0),
    "stacked.five_ms": ("<=", 1.0),
    "mik+a.replayed_ms": ("<=", 3.3),
    "acro.replayed_ms": ("<=", 2.6),
    "five_encoders.each_ms": ("<=", 2.5),
    "iql.eager_over_replayed": (">=", 9.0),
    "bc.eager_over_replayed": (">=", 9.0),
    "drqv2_bc.eager_over_replayed": (">=", 9.0),
    "drq_bc.eager_over_replayed": (">=", 3.0),
    "encoding.seconds": ("<=", 15.0),
    "evaluation.seconds": ("<=", 60.0),
}
"""What is promised of one H200, its evaluation of 16 cores with EGL."""
CORRUPTION = "patch+zero_frames"
SEEDS = 5
_SETTLED = 12
"""Steps before anything is timed: more than are run before a step is captured."""


@dataclass(frozen=True)
class Size:
    """How much is measured; the preset's settings but for those here."""

    episodes: int
    hidden_dim: int
    batch_size: int
    windows: int
    """In a batch of pretraining."""
    views: int
    blocks: int
    updates: int
    """Of a policy, in a block."""
    steps: int
    """Of an encoder, in a block."""
    played: int
    """Episodes of the evaluation."""
    decisions: int
    """Of each."""


PAPER = Size(100, 1024, 256, 16, 4, 7, 200, 40, 100, 500)
TINY = Size(2, 16, 8, 2, 1, 1, 2, 1, 1, 3)
"""Shows on any machine in seconds that all runs, and measures nothing worth telling."""


def gpu_bench(device_name: str = "auto", quick: bool = False) -> dict[str, Any]:
    """Run every measurement.

    Args:
        device_name: a GPU's; a CPU is accepted for a trial of the code, with `quick`.
        quick: trial sizes, whose numbers claim nothing.

    Returns:
        Nested times, ratios and peaks of memory, with the machine, the commit and the versions.

    Raises:
        UserError: no GPU is visible, and none of this is a trial.
    """
    device = pick_device(device_name)
    if device.type != "cuda" and not quick:
        raise UserError("bench --gpu measures a GPU, and none is visible: on a CPU, try the code with --quick")
    torch.manual_seed(0)
    size = TINY if quick else PAPER
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset = synthetic_set(folder, size.episodes)[0].to(device)
        encoder = Encoder(EncoderConfig(dataset.action_dim)).to(device).eval()
        features, results["encoding"] = encoding(dataset, encoder, folder, size)
        results |= policies(dataset, features, size)
        results["td3_bc"] |= peer(dataset, features, size, results["td3_bc"]["replayed_ms"])
        results["drq_bc"] = measured(lambda: end_to_end(dataset, size), device, size.steps, size.blocks)
        for method in ("mik+a", "acro"):
            config = pretraining(folder, method, size)
            results[method] = measured(
                lambda config=config: make_trainer(dataset, config).update, device, size.steps, size.blocks
            )
        results["five_encoders"] = five_encoders(dataset, folder, size)
        del features
        results["evaluation"] = evaluation(encoder, dataset, folder, size)
    about = machine(device_name)
    return results | {"machine": about, "commit": git_commit(), "versions": versions()}


def measured(
    make: Callable[[], Callable[[], Any]], device: torch.device, steps: int, blocks: int
) -> dict[str, float]:
    """Milliseconds of a step, run as it is and replayed, and the memory that replaying it takes at most."""
    with eager():
        slow = milliseconds(make(), device, max(1, steps // 4), max(1, blocks // 2))
    free(device)
    step = make()
    fast = milliseconds(step, device, steps, blocks)
    told = {"eager_ms": slow, "replayed_ms": fast, "eager_over_replayed": slow / fast} | peak(device)
    del step
    free(device)
    return told


def milliseconds(step: Callable[[], Any], device: torch.device, steps: int, blocks: int) -> float:
    """Median over blocks of so many steps, of one step."""
    for _ in range(_SETTLED if device.type == "cuda" else 1):
        step()
    times = []
    for _ in range(blocks):
        wait(device)
        start = time.perf_counter()
        for _ in range(steps):
            step()
        wait(device)
        times.append((time.perf_counter() - start) / steps * 1e3)
    return statistics.median(times)


@contextmanager
def eager() -> Iterator[None]:
    """What is made here is never replayed."""
    before = os.environ.get(EAGER_VARIABLE)
    os.environ[EAGER_VARIABLE] = "1"
    try:
        yield
    finally:
        del os.environ[EAGER_VARIABLE]
        if before is not None:
            os.environ[EAGER_VARIABLE] = before


def wait(device: torch.device) -> None:
    """Until a GPU has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def free(device: torch.device) -> None:
    """Give back the memory of what is gone, and begin to watch its peak."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def peak(device: torch.device) -> dict[str, float]:
    """Most memory of a GPU that tensors took since `free`, the data set's among them."""
    return {"peak_gib": torch.cuda.max_memory_allocated(device) / 2**30} if device.type == "cuda" else {}


def pretraining(folder: Path, method: str, size: Size, seed: int = 0) -> PretrainConfig:
    """Settings of a pretraining: the `paper` preset in bf16."""
    config = PretrainConfig.of(
        "paper", data=folder, out=folder, method=method, corruption=CORRUPTION, precision="bf16", seed=seed
    )
    return config.altered(batch_size=size.windows)


def encoding(dataset: Dataset, encoder: Encoder, folder: Path, size: Size) -> tuple[torch.Tensor, dict[str, float]]:
    """The features of a set's views, and what they take."""
    device = dataset.t.device
    free(device)
    config = FinetuneConfig.of("paper", precision="bf16")
    frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.of(CORRUPTION), config.shift, config.precision, 0)
    histories = Histories(dataset, NO_OPTIONS, 3, 0)
    start = time.perf_counter()
    features = encode_views(frozen, histories, size.views, folder / "features.npy")
    wait(device)
    seconds = time.perf_counter() - start
    return features, {"views": size.views, "episodes": dataset.num_episodes, "seconds": seconds} | peak(device)


def policies(dataset: Dataset, features: torch.Tensor, size: Size) -> dict[str, dict[str, float]]:
    """Updates of every algorithm on features, sampling included, and of stacked seeds of TD3+BC."""
    device = dataset.t.device
    results: dict[str, dict[str, float]] = {}
    for name in ("td3_bc", "iql", "bc", "drqv2_bc"):
        results[name] = measured(
            lambda name=name: on_features(dataset, features, name, size, 1), device, size.updates, size.blocks
        )
    five = milliseconds(on_features(dataset, features, "td3_bc", size, SEEDS), device, size.updates, size.blocks)
    results["stacked"] = {"five_ms": five, "a_seed_ms": five / SEEDS} | peak(device)
    free(device)
    return results


def five_encoders(dataset: Dataset, folder: Path, size: Size) -> dict[str, float]:
    """Milliseconds that a step of each of five pretrainings at a time takes: all five's over five.

    In one process, each on a stream of its own, and in a process each; the better way counts.
    """
    device = dataset.t.device
    streams = [torch.cuda.Stream(device) if device.type == "cuda" else None for _ in range(SEEDS)]
    updates = [make_trainer(dataset, pretraining(folder, "mik+a", size, seed)).update for seed in range(SEEDS)]

    def step() -> None:
        for stream, update in zip(streams, updates, strict=True):
            with torch.cuda.stream(stream):
                update()

    in_one = milliseconds(step, device, size.steps, size.blocks) / SEEDS
    told = {"on_streams_ms": in_one} | peak(device)
    updates.clear()
    free(device)
    seconds = 4.0 if size is PAPER else 0.1
    with ExitStack() as stack:
        workers = [
            stack.enter_context(Worker("pretraining_steps", str(folder), str(device), size.windows, seed, seconds))
            for seed in range(SEEDS)
        ]
        speed = sum(told["steps_per_s"] for told in at_once(workers))
    return told | {"in_processes_ms": 1e3 / speed, "each_ms": min(in_one, 1e3 / speed)}


def peer(dataset: Dataset, features: torch.Tensor, size: Size, replayed_ms: float) -> dict[str, Any]:
    """The same update in JAX: on this card if JAX sees it, and only then a ratio."""
    if importlib.util.find_spec("jax") is None:
        return {"jax": "not installed: `pip install '.[policy]'` in the package's folder"}
    shape = {
        "hidden_dim": size.hidden_dim,
        "batch_size": size.batch_size,
        "dim": features.shape[-1],
        "action_dim": dataset.action_dim,
        "views": len(features),
        "rows": dataset.num_rows,
    }
    told: dict[str, Any] = {}
    for tf32 in (False, True):
        try:
            # without the variable JAX takes three quarters of the card's memory as it starts
            with Worker("jax_updates", shape, size.updates, tf32, XLA_PYTHON_CLIENT_PREALLOCATE="false") as worker:
                worker.answer(60)
                answers = []
                for _ in range(size.blocks):
                    worker.begin()
                    answers.append(worker.answer(60))
        except WorkerDiedError as error:
            return told | {"jax": first_line(error)}
        device, ms = answers[0]["device"], statistics.median(answer["ms"] for answer in answers)
        if device == "cpu":  # a kind of processor, in JAX's words
            return {"jax": f"sees no GPU: {ms:.3g} ms on the CPU"}
        told |= {"jax_tf32_ms": ms} if tf32 else {"jax_ms": ms, "jax_over_replayed": ms / replayed_ms}
    return told


def evaluation(encoder: Encoder, dataset: Dataset, folder: Path, size: Size, limit: float = 90.0) -> dict[str, Any]:
    """Seconds of an evaluation on every core, unless nothing can be drawn here or it takes over `limit`."""
    card = EncoderCard("mik+a", "walker_walk", "bench", flat(CorruptionConfig.of(CORRUPTION)), 0, 0, "paper")
    save_encoder(folder / "encoder", encoder, card)
    Policy(encoder.dim, dataset.action_dim, size.hidden_dim).save(folder / "policy")
    told = {"episodes": size.played, "cores": os.cpu_count()}
    try:
        with Worker("playing", str(folder), size.played, size.decisions) as worker:
            worker.answer()
            worker.begin()
            return told | worker.answer(limit)
    except WorkerDiedError as error:
        return told | {"left_out": first_line(error)}
