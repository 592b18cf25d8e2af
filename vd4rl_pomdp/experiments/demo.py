"""The demo: every stage on a small set with real rendering. It shows that all works, not which method is best."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import read_episodes
from vd4rl_pomdp.runs.outputs import refuse_kept

METHODS = ("mik+a", "acro", "random")
CORRUPTION = "patch+zero_frames"
QUALITY = "expert_noisy"
"""Where actions are not decided by the state alone, returns tell memories apart soonest."""


@dataclass(frozen=True)
class Size:
    """What the stages of a demo are told."""

    episodes: int
    pretrain: str
    finetune: str


PRESETS = {
    "cpu": Size(
        20,
        "--preset cpu --steps 600 --log-every 25 --checkpoint-every 100",
        "--preset cpu --updates 6000 --update-precision bf16 --views 2 --eval-every 6000 --eval-episodes 8",
    ),
    "smoke": Size(2, "--preset smoke", "--preset smoke"),
}


def demo_commands(out: Path, workers: int, preset: str = "cpu") -> Iterator[list[str]]:
    """Words of every stage's command line, in order."""
    size = PRESETS[preset]
    data = str(out / "data" / "walker_walk" / QUALITY)
    collect = ["--task", "walker_walk", "--quality", QUALITY, "--episodes", str(size.episodes), "--out", data]
    yield ["data", "collect", *collect, "--workers", str(workers)]
    for method in METHODS:
        folder = out / "runs" / method
        place = ["--data", data, "--out", str(folder / "pretrain")]
        yield ["pretrain", "--method", method, "--corruption", CORRUPTION, *place, *size.pretrain.split()]
        place = ["--encoder", str(folder / "pretrain" / "encoder"), "--data", data, "--out", str(folder / "finetune")]
        yield ["finetune", *place, *size.finetune.split(), "--workers", str(workers)]
    yield ["report", str(out / "runs"), "--out", str(out / "report")]


def demo(out: Path, workers: int, preset: str, run: Callable[[list[str]], None]) -> None:
    """Run every command of the demo, printing each so that it can be run by hand.

    Args:
        out: folder of data, runs and report.
        workers: processes, 0 for every core.
        preset: how long the stages take, one of PRESETS; UserError for another.
        run: what carries out one command line.
    """
    if preset not in PRESETS:
        raise UserError(f"unknown preset {preset!r}: choose one of {', '.join(PRESETS)}")
    refuse_kept(out)
    started = time.monotonic()
    for words in demo_commands(out, workers, preset):
        print(f"\n$ vd4rl-pomdp {' '.join(words)}", file=sys.stderr)
        run(words)
    print("\n".join(conclusion(out / "runs")))
    print(f"demo finished in {(time.monotonic() - started) / 60:.1f} minutes")


def conclusion(runs: Path) -> Iterator[str]:
    """What the returns of the demo's methods say, and how sure it is: lines of text."""
    yield f"Returns under {CORRUPTION}, and where nothing is hidden (mean ± standard error over episodes):"
    for method in METHODS:
        rows = read_episodes(runs / method / "finetune" / "episodes.csv")
        last = max(row["step"] for row in rows)
        shown = (_mean_and_error([r["return"] for r in rows if (r["step"], r["evaluated_under"]) == (last, under)])
                 for under in (CORRUPTION, "none"))  # fmt: skip
        yield f"  {method:<8}" + ", ".join(shown)
    yield "One seed each: another may end elsewhere. What several seeds say of 100 episodes is in results/control."


def _mean_and_error(returns: list[float]) -> str:
    error = f" ± {np.std(returns, ddof=1) / math.sqrt(len(returns)):.0f}" if len(returns) > 1 else ""
    return f"{np.mean(returns):.0f}{error} (n = {len(returns)})"
