"""Draw docs/hero.png: what an agent sees under each corruption, and what policies return under both.

python tools/hero.py --data data/walker_walk/expert_noisy
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import offline_table
import torch
from script import run_script

from vd4rl_pomdp.corruptions import BatchCorruption
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.report.gates import episodes_of
from vd4rl_pomdp.report.stats import mean_interval

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SEEN = {"clean": "none", "16x16 patches": "patch", "two frames zeroed": "zero_frames"}
"""What is above each stack, and its corruption."""
COLOURS = {"random": "#999999", "acro": "#56B4E9", "mik": "#E69F00", "mik+a": "#D55E00", "supervised+a": "#009E73"}
"""Methods from left to right, in Okabe and Ito's colours."""
SETTING = ("walker_walk", "expert_noisy", "patch+zero_frames", "td3_bc")


@dataclass(frozen=True)
class Config:
    """Draw the picture at the head of README.md; returns are those of results/control."""

    data: Path
    """A set of walker_walk, expert_noisy."""
    row: int = 700
    """The observation that is shown, by its transition."""
    out: Path = Path(__file__).parents[1] / "docs" / "hero.png"
    """Where the picture goes."""


def stack_seen(data: Dataset, row: int, corruption: str) -> np.ndarray:
    """An observation's three frames, oldest first, side by side: (84, 264, 3) uint8 with white between them."""
    obs = View(data).transitions([row]).obs.clone()
    frames = BatchCorruption(corruption, seed=3)(obs, torch.tensor([row])).view(3, 3, 84, 84).numpy()
    picture = np.full((84, 264, 3), 255, np.uint8)
    for place, frame in enumerate(frames.transpose(0, 2, 3, 1)):
        picture[:, 90 * place : 90 * place + 84] = frame
    return picture


def returns() -> dict[str, tuple[float, float, float]]:
    """Mean return of each method with its 95% interval over seeds and episodes."""
    labels = ("task", "quality", "corruption", "algorithm")
    here = [run for run in offline_table.main_runs() if tuple(run.labels[name] for name in labels) == SETTING]
    found = {}
    for method in COLOURS:
        episodes = episodes_of([run for run in here if run.method == method])
        low, high = mean_interval(episodes)
        found[method] = (float(episodes.mean()), low, high)
    return found


def main(config: Config) -> None:
    """Three stacks on the left, a bar for each method on the right."""
    data = open_dataset(config.data)
    figure = plt.figure(figsize=(10, 3.3), dpi=160)
    grid = figure.add_gridspec(len(SEEN), 2, width_ratios=(1, 1.25), wspace=0.16, hspace=0.32)
    for place, (words, corruption) in enumerate(SEEN.items()):
        axes = figure.add_subplot(grid[place, 0])
        axes.imshow(stack_seen(data, config.row, corruption), interpolation="nearest")
        axes.set_title(words, fontsize=9, loc="left", pad=3)
        axes.axis("off")
    axes = figure.add_subplot(grid[:, 1])
    for place, (method, (mean, low, high)) in enumerate(returns().items()):
        axes.bar(place, mean, color=COLOURS[method], yerr=[[mean - low], [high - mean]], capsize=4, width=0.7)
        axes.annotate(f"{mean:.0f}", (place, high), xytext=(0, 3), textcoords="offset points", fontsize=9, ha="center")
    axes.set_xticks(range(len(COLOURS)), COLOURS, fontsize=9)
    axes.set_ylim(0, 900)
    axes.set_ylabel("return (of 1000)")
    axes.set_title("walker_walk, noisy expert, patches and two frames zeroed", fontsize=9, loc="left", pad=3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(config.out, bbox_inches="tight", pad_inches=0.08)


if __name__ == "__main__":
    run_script(main, Config)
