"""Two runs side by side on the same cores, and what threads that sleep while they wait cost a run that is alone.

The library that torch's threads wait in is told how when it is loaded, so every measurement is a process of its own.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack

import torch

_TRAIN = "import sys; from vd4rl_pomdp.bench.sharing import train; train(float(sys.argv[1]))"
_WARM_UP = 20


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
    from vd4rl_pomdp.bench.data import BATCH
    from vd4rl_pomdp.nn.encoder import EncoderConfig
    from vd4rl_pomdp.nn.policy import Policy

    torch.manual_seed(0)
    config, dim, actions = FinetuneConfig.of("cpu"), EncoderConfig(6).feature_dim, 6
    policy = Policy(dim, actions, config.hidden_dim)
    generator = torch.Generator().manual_seed(0)
    algorithm = TD3BC(policy, config.options, config.learning_rate, config.updates, generator)  # type: ignore[arg-type]
    z, action, next_z = (torch.randn(BATCH, width) for width in (dim, actions, dim))
    batch = FeatureBatch(z, action.tanh(), torch.rand(BATCH), torch.ones(BATCH), next_z)
    for _ in range(_WARM_UP):
        algorithm.update(batch)
    print("ready", flush=True)
    sys.stdin.readline()
    start, updates = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < seconds:
        algorithm.update(batch)
        updates += 1
    print(updates / spent)
