"""Peak memory of pretraining; its workers import this module alone, and so what training imports and no more."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.runs.workers import run_jobs

if TYPE_CHECKING:
    from pretrain.config import PretrainConfig
    from pretrain.train import Trainer

STEPS = 3


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
