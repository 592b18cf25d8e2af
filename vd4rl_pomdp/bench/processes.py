"""Measurements in separate processes, which import only this module: peak memory, concurrent runs, JAX.

How OpenMP threads wait is fixed when the library is loaded, so measuring another policy takes a new process, too.
"""

from __future__ import annotations

import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from finetune.algorithms import TD3BC
from finetune.config import FinetuneConfig
from finetune.features import FeatureBatch
from pretrain.config import PretrainConfig
from pretrain.train import Trainer, build_objective, build_target, make_batches
from vd4rl_pomdp.core.errors import WorkerDiedError
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.nn.encoder import EncoderConfig
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.workers import run_jobs

JAX_MISSING = "not installed: `pip install '.[policy]'` in the package's folder"
_STATUS = Path("/proc/self/status")
_SERVE = "from vd4rl_pomdp.bench.processes import serve; serve()"


def apart(function: str, *arguments: Any, count: int = 1, **environment: str) -> list[dict[str, Any]]:
    """Run a measurement in `count` fresh processes, all at the same time once every one is ready.

    `function` is the "module.name" of one that prepares the measurement from JSON-serialisable arguments and returns a
    function returning a dict. WorkerDiedError if a process ends without an answer.
    """
    words = [sys.executable, "-c", _SERVE, json.dumps([function, *arguments])]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes: list[Any] = [subprocess.Popen(words, env=os.environ | environment, **pipes) for _ in range(count)]
    try:
        if not all(process.stdout.readline() for process in processes):
            raise WorkerDiedError("a benchmark process ended without a result")
        for process in processes:
            process.stdin.write("\n")
            process.stdin.flush()
        return [json.loads(process.communicate()[0]) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def serve() -> None:
    """Main function of a process of `apart`."""
    function, *arguments = json.loads(sys.argv[1])
    module, _, name = function.rpartition(".")
    measure = getattr(importlib.import_module(module), name)(*arguments)
    print("ready", flush=True)
    sys.stdin.readline()
    print(json.dumps(measure()), flush=True)


def make_trainer(dataset: Dataset, config: PretrainConfig) -> Trainer:
    """A trainer for the config's objective; its codebook is fitted to a few actions."""
    target = build_target(config, dataset.action[:2000].cpu().numpy())
    objective = build_objective(config, dataset.action_dim, target).to(dataset.t.device)
    return Trainer(objective, make_batches(dataset, config, objective), config)


def touch(frames: torch.Tensor) -> None:
    """Read every page, so that all are in the page cache and mapped."""
    frames.view(-1)[::4096].max()


def memory(folder: Path, frame_bytes: int) -> dict[str, float]:
    """Peak memory of a process that trains on the dataset in `folder`, and what a second one adds beyond the shared
    frames; empty where /proc is missing."""
    if not _STATUS.exists():
        return {}
    peak, private = next(iter(run_jobs(_train_a_little, [folder, folder], 2)))
    return {
        "frames_gib": frame_bytes / 2**30,
        "peak_over_frames": peak / frame_bytes,
        "second_process_over_frames": private / frame_bytes,
    }


def _train_a_little(folder: Path) -> list[int]:
    """Peak resident bytes and unshared bytes of a process that reads the whole dataset and trains."""
    dataset = open_dataset(folder / "set", folder / "cache")
    trainer = make_trainer(dataset, PretrainConfig.of("cpu", data=folder, out=folder, corruption="patch+zero_frames"))
    for _ in range(3):
        trainer.update()
    touch(dataset.frames)
    fields = dict(line.split(":", 1) for line in _STATUS.read_text(encoding="utf-8").splitlines())
    return [int(fields[name].split()[0]) * 1024 for name in ("VmHWM", "RssAnon")]


def sharing(seconds: float, rounds: int = 3) -> dict[str, float]:
    """Updates/s of a single run; ratio of the slower of two concurrent runs to it, and of it to one whose
    threads spin as long as PyTorch's default. Medians over alternating rounds."""

    def slowest(**how: Any) -> float:
        return min(answer["updates_per_s"] for answer in apart(f"{__name__}.training", seconds, **how))

    speeds = [(slowest(), slowest(count=2), slowest(GOMP_SPINCOUNT="300000")) for _ in range(rounds)]
    alone, together, spinning = (statistics.median(column) for column in zip(*speeds, strict=True))
    return {"updates_per_s": alone, "of_two_over_alone": together / alone, "over_spinning": alone / spinning}


def training(seconds: float) -> Callable[[], dict[str, float]]:
    """Fine-tune on random features with the cpu preset for this many seconds."""
    dim, actions = EncoderConfig(6).feature_dim, 6
    algorithm = _td3_bc(FinetuneConfig.of("cpu"), dim, actions)
    z, action, next_z = (torch.randn(256, width) for width in (dim, actions, dim))
    action = action.tanh()
    batch = FeatureBatch(z, action, torch.rand(256), torch.ones(256), next_z, action)
    for _ in range(20):
        algorithm.update(batch)

    def measure() -> dict[str, float]:
        start, updates, spent = time.perf_counter(), 0, 0.0
        while spent < seconds:  # at least one update, however busy the machine is
            algorithm.update(batch)
            updates, spent = updates + 1, time.perf_counter() - start
        return {"updates_per_s": updates / spent}

    return measure


def _td3_bc(config: FinetuneConfig, dim: int, action_dim: int) -> TD3BC:
    torch.manual_seed(0)
    policy, draws = Policy(dim, action_dim, config.hidden_dim), RandomStream(torch.Generator())
    return TD3BC(policy, config.options, config.learning_rate, config.updates, draws)  # type: ignore[arg-type]


def jax_updates(shape: dict[str, int], updates: int, blocks: int, tf32: bool = False) -> Callable[[], dict[str, Any]]:
    """TD3+BC in JAX on random features (see `jax_peer`), on JAX's default device: median milliseconds per update.

    An even number of updates per call, `blocks` calls. With `tf32`, a GPU's matrix products are in TF32 (JAX's default)
    instead of float32 (PyTorch's).
    """
    import jax  # an optional dependency

    from vd4rl_pomdp.bench import jax_peer

    jax.config.update("jax_default_matmul_precision", "tensorfloat32" if tf32 else "float32")
    rows, dim, actions = shape["rows"], shape["dim"], shape["action_dim"]
    algorithm = _td3_bc(FinetuneConfig.of("paper", hidden_dim=shape["hidden_dim"]), dim, actions)
    first = torch.arange(rows - 3).expand(shape["views"], -1)
    features = torch.randn(shape["views"], rows, dim).half()
    transitions = torch.rand(rows - 3, actions), torch.rand(rows - 3), torch.ones(rows - 3)
    scale = algorithm.policy.standardise.mean, algorithm.policy.standardise.std
    table = jax_peer.Table(*map(jax_peer.as_jax, (features, first, first + 3, *transitions, *scale)))
    learnt, key = jax_peer.learnt_by(algorithm), jax.random.key(0)
    make = jax_peer.make_updates(algorithm)

    def train(learnt: Any, table: Any, key: Any) -> Any:
        return make(learnt, table, jax_peer.draw(key, table, updates, shape["batch_size"]))

    compiled = jax.jit(train, donate_argnums=0)

    def block() -> float:
        nonlocal learnt, key
        key, drawn = jax.random.split(key)
        start = time.perf_counter()
        learnt, losses = compiled(learnt, table, drawn)
        jax.block_until_ready((learnt, losses))
        return (time.perf_counter() - start) / updates * 1e3

    for _ in range(2):
        block()
    return lambda: {
        "ms": statistics.median(block() for _ in range(blocks)),
        "device": jax.devices()[0].device_kind,
    }
