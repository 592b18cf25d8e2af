"""What is measured in processes of their own, which import this module alone: peak memory, and runs side by side.

The library that torch's threads wait in is told how when it is loaded, so a run that waits otherwise is a process, too.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from vd4rl_pomdp.core.errors import WorkerDiedError
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.runs.workers import run_jobs

if TYPE_CHECKING:
    from pretrain.config import PretrainConfig
    from pretrain.train import Trainer

STEPS = 3
JAX_MISSING = "not installed: `pip install '.[policy]'` in the package's folder"
_SERVE = "from vd4rl_pomdp.bench.processes import serve; serve()"
_WARM_UP = 20


def memory(folder: Path, frame_bytes: int) -> dict[str, float]:
    """Peak memory of a process that trains on the set in `folder`, and what a second one adds: all but the frames.

    The latter is left out where the system does not tell it.
    """
    peak, private = next(iter(run_jobs(_train_a_little, [folder, folder], 2)))
    ratios = {"frames_gib": frame_bytes / 2**30, "peak_over_frames": peak / frame_bytes}
    return ratios if private is None else ratios | {"second_process_over_frames": private / frame_bytes}


def make_trainer(dataset: Dataset, config: PretrainConfig) -> Trainer:
    """A trainer of the config's objective, its codebook fitted on a few actions."""
    from pretrain.build import build_objective, build_target
    from pretrain.train import Trainer, make_batches

    target = build_target(config, dataset.action[:2000].cpu().numpy())
    objective = build_objective(config, dataset.action_dim, target)
    objective = objective.to(dataset.t.device)
    return Trainer(objective, make_batches(dataset, config, objective), config)


def touch(frames: torch.Tensor) -> None:
    """Read every page, so that it is in the page cache and mapped."""
    frames.view(-1)[::4096].max()


def _train_a_little(folder: Path) -> tuple[int, int | None]:
    """Peak resident bytes of a process that reads the whole set and trains, and how many of them it does not share."""
    from pretrain.config import PretrainConfig

    dataset = open_dataset(folder / "set", folder / "cache")
    config = PretrainConfig.of("cpu", data=folder, out=folder, corruption="patch+zero_frames")
    trainer = make_trainer(dataset, config)
    for _ in range(STEPS):
        trainer.update()
    touch(dataset.frames)
    return resident()


def resident(status: Path = Path("/proc/self/status")) -> tuple[int, int | None]:
    """Peak resident bytes of this process, and how many of those it has now it does not share.

    `status` is where Linux tells them; elsewhere the peak is the system's own, and the other None. On Linux that peak
    would be no less than that of the process that started this one.
    """
    if status.exists():
        fields = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines())
        peak, private = (int(fields[name].split()[0]) * 1024 for name in ("VmHWM", "RssAnon"))
        return peak, private
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024), None


def sharing(seconds: float, rounds: int = 3) -> dict[str, float]:
    """Updates/s of a run alone, the slower of two at a time against it, and it against one that waits actively.

    Args:
        seconds: how long each process trains.
        rounds: measurements of each, in turns, of which the medians count.
    """
    speeds = [
        (min(_speeds(seconds, 1)), min(_speeds(seconds, 2)), min(_speeds(seconds, 1, OMP_WAIT_POLICY="ACTIVE")))
        for _ in range(rounds)
    ]
    alone, together, active = (statistics.median(column) for column in zip(*speeds, strict=True))
    return {"updates_per_s": alone, "of_two_over_alone": together / alone, "passive_over_active": alone / active}


def _speeds(seconds: float, count: int, **environment: str) -> list[float]:
    """Updates/s of so many processes that train at the same time."""
    with ExitStack() as stack:
        workers = [stack.enter_context(Worker("training", seconds, **environment)) for _ in range(count)]
        return [told["updates_per_s"] for told in at_once(workers)]


class Worker:
    """A process that calls a function, which prepares a measurement, and measures when it is asked."""

    def __init__(self, function: str, *arguments: Any, **environment: str) -> None:
        """Start it.

        Args:
            function: its name, with its module's where that is not this one; it returns a function without
                arguments that returns a dict.
            arguments: what JSON can write.
            environment: variables of the process.
        """
        self.process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, json.dumps([function, *arguments])],
            env=os.environ | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def begin(self) -> None:
        """Tell it to measure once."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def answer(self, within: float = 600.0) -> dict[str, Any]:
        """What it measured, or, the first time, that it is ready.

        Raises:
            WorkerDiedError: it ended, or took longer than `within` seconds, after which it is killed.
        """
        assert self.process.stdout is not None
        timer = threading.Timer(within, self.process.kill)
        timer.daemon = True  # a signal may end this process while it waits
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        if not line:
            raise WorkerDiedError(f"a measuring process ended without an answer, or took over {within:.0f} s")
        answer: dict[str, Any] = json.loads(line)
        return answer


def at_once(workers: Sequence[Worker]) -> list[dict[str, Any]]:
    """What fresh workers measure at the same time, once all of them are ready."""
    for worker in workers:
        worker.answer()
    for worker in workers:
        worker.begin()
    return [worker.answer() for worker in workers]


def named(function: str) -> Callable[..., Callable[[], dict[str, Any]]]:
    """The function that a `Worker` is told."""
    module, _, name = function.rpartition(".")
    found: Callable[..., Callable[[], dict[str, Any]]] = getattr(importlib.import_module(module or __name__), name)
    return found


def serve() -> None:
    """The process of a `Worker`."""
    name, *arguments = json.loads(sys.argv[1])
    measure = named(name)(*arguments)
    print("{}", flush=True)  # it is ready
    for _ in sys.stdin:
        print(json.dumps(measure()), flush=True)


def training(seconds: float) -> Callable[[], dict[str, float]]:
    """Fine-tune on random features as the cpu preset does, for so long."""
    from finetune.algorithms import TD3BC
    from finetune.config import FinetuneConfig
    from finetune.features import FeatureBatch
    from vd4rl_pomdp.core.streams import RandomStream
    from vd4rl_pomdp.nn.encoder import EncoderConfig
    from vd4rl_pomdp.nn.policy import Policy

    torch.manual_seed(0)
    config, dim, actions = FinetuneConfig.of("cpu"), EncoderConfig(6).feature_dim, 6
    policy = Policy(dim, actions, config.hidden_dim)
    draws = RandomStream(torch.Generator().manual_seed(0))
    algorithm = TD3BC(policy, config.options, config.learning_rate, config.updates, draws)  # type: ignore[arg-type]
    z, action, next_z = (torch.randn(256, width) for width in (dim, actions, dim))
    action = action.tanh()
    batch = FeatureBatch(z, action, torch.rand(256), torch.ones(256), next_z, action)
    for _ in range(_WARM_UP):
        algorithm.update(batch)

    def measure() -> dict[str, float]:
        start, updates = time.perf_counter(), 0
        while (spent := time.perf_counter() - start) < seconds:
            algorithm.update(batch)
            updates += 1
        return {"updates_per_s": updates / spent}

    return measure


def jax_updates(shape: dict[str, int], updates: int, tf32: bool = False) -> Callable[[], dict[str, Any]]:
    """The peer's TD3+BC on random features (see `jax_peer`), `updates` a call, on the device that JAX picks.

    Args:
        shape: `hidden_dim`, `batch_size`, `dim`, `action_dim`, `views`, `rows`.
        updates: even.
        tf32: on a GPU, products of TF32 numbers, JAX's own default; else of float32 numbers, PyTorch's.
    """
    import jax

    from finetune.algorithms import TD3BC
    from finetune.config import FinetuneConfig
    from vd4rl_pomdp.bench import jax_peer
    from vd4rl_pomdp.core.streams import RandomStream
    from vd4rl_pomdp.nn.policy import Policy

    jax.config.update("jax_default_matmul_precision", "tensorfloat32" if tf32 else "float32")
    torch.manual_seed(0)
    config, rows, dim, actions = FinetuneConfig.of("paper"), shape["rows"], shape["dim"], shape["action_dim"]
    policy = Policy(dim, actions, shape["hidden_dim"])
    draws = RandomStream(torch.Generator())
    algorithm = TD3BC(policy, config.options, config.learning_rate, config.updates, draws)  # type: ignore[arg-type]
    first = torch.arange(rows - 3).expand(shape["views"], -1)
    features = torch.randn(shape["views"], rows, dim).half()
    told = torch.rand(rows - 3, actions), torch.rand(rows - 3), torch.ones(rows - 3)
    scale = policy.standardise.mean, policy.standardise.std
    table = jax_peer.Table(*map(jax_peer.as_jax, (features, first, first + 3, *told, *scale)))
    learnt, key = jax_peer.learnt_by(algorithm), jax.random.key(0)
    make = jax_peer.make_updates(algorithm)

    def train(learnt: Any, table: Any, key: Any) -> Any:
        return make(learnt, table, jax_peer.draw(key, table, updates, shape["batch_size"]))

    compiled = jax.jit(train, donate_argnums=0)

    def measure() -> dict[str, Any]:
        nonlocal learnt, key
        key, drawn = jax.random.split(key)
        start = time.perf_counter()
        learnt, losses = compiled(learnt, table, drawn)
        jax.block_until_ready((learnt, losses))
        return {"ms": (time.perf_counter() - start) / updates * 1e3, "device": jax.devices()[0].device_kind}

    for _ in range(2):
        measure()
    return measure


def playing(run: str, episodes: int, decisions: int) -> Callable[[], dict[str, float]]:
    """Play episodes of the encoder and the policy in a folder, on every core."""
    from finetune.evaluation import evaluate, jobs_of
    from vd4rl_pomdp.core.tasks import TASKS
    from vd4rl_pomdp.corruptions import CorruptionConfig

    def measure() -> dict[str, float]:
        under = [CorruptionConfig.of("patch+zero_frames")]
        start = time.perf_counter()
        evaluate(jobs_of(Path(run), TASKS.named("walker_walk"), under, episodes, decisions), 0)
        return {"seconds": time.perf_counter() - start}

    return measure
