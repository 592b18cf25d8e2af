"""What is measured in processes of their own, which import this module alone: peak memory, and runs side by side.

The library that torch's threads wait in is told how when it is loaded, so a run that waits otherwise is a process, too.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.runs.workers import run_jobs

if TYPE_CHECKING:
    from pretrain.config import PretrainConfig
    from pretrain.train import Trainer

STEPS = 3
_TRAIN = "import sys; from vd4rl_pomdp.bench.processes import train; train(float(sys.argv[1]))"
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
        processes = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", _TRAIN, str(seconds)],
                    env=os.environ | environment,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
            for _ in range(count)
        ]
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()  # it is ready
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        return [float(process.communicate()[0]) for process in processes]


def train(seconds: float) -> None:
    """Fine-tune on random features as the cpu preset does: print that it is ready, wait for a line, print updates/s."""
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
    batch = FeatureBatch(z, action.tanh(), torch.rand(256), torch.ones(256), next_z)
    for _ in range(_WARM_UP):
        algorithm.update(batch)
    print("ready", flush=True)
    sys.stdin.readline()
    start, updates = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < seconds:
        algorithm.update(batch)
        updates += 1
    print(updates / spent)
