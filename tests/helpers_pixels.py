"""A small dataset of images with known state: a ball on a marked floor, moved by each action."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from pretrain.config import PretrainConfig
from pretrain.train import Trainer, build_objective, build_target, make_batches
from vd4rl_pomdp.core.streams import seed_networks
from vd4rl_pomdp.core.tasks import FRAME_STACK
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.nn.probes import probe_error

SIZE, LOW, HIGH, STEP, RADIUS = 32, 8, 24, 6.0, 2.6
EPISODES, ROWS = 24, 40


def picture(position: np.ndarray | None) -> np.ndarray:
    """(3, 32, 32) uint8: lines on the floor, which reveal shifts, and optionally a ball."""
    frame = np.full((3, SIZE, SIZE), 60, np.uint8)
    frame[0, 6:8], frame[1, :, 6:8], frame[2, 24:26], frame[0, :, 24:26] = 160, 160, 200, 120
    if position is not None:
        y, x = np.mgrid[:SIZE, :SIZE]
        frame[:, (y - position[1]) ** 2 + (x - position[0]) ** 2 < RADIUS**2] = 255
    return frame


def _episode(rng: np.random.Generator, ball: bool) -> dict[str, np.ndarray]:
    """Uniform actions that move the ball by up to 6 pixels per axis, within the marked lines."""
    action = rng.uniform(-1, 1, (ROWS, 2)).astype(np.float32)
    action[0] = 0
    position = [rng.uniform(LOW, HIGH, 2)]
    for taken in action[1:]:
        position.append(np.clip(position[-1] + STEP * taken, LOW, HIGH))
    step_type = np.full(ROWS, StepType.MID)
    step_type[0], step_type[-1] = StepType.FIRST, StepType.LAST
    return {
        "observation": np.stack([picture(p if ball else None) for p in position]),
        "action": action,
        "reward": np.zeros(ROWS),
        "discount": np.ones(ROWS),
        "step_type": step_type,
        "physics": np.stack(position),
    }


def ball_world(folder: Path, ball: bool = True) -> Dataset:
    """24 episodes of 40 rows; `physics` holds the ball's position. Without a ball all images are equal."""
    rng = np.random.default_rng(0)
    episodes = [_episode(rng, ball) for _ in range(EPISODES)]
    (folder / "set").mkdir(parents=True)
    rows = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    write_shard(folder / "set" / "0_ball.hdf5", rows, {})
    return open_dataset(folder / "set", folder / "cache")


def trainer_on(dataset: Dataset, method: str, **settings: Any) -> Trainer:
    """A small trainer of a method on the dataset, with its random shifts."""
    small = {"batch_size": 8, "window": 8, "frame_encoder": "small", "feature_dim": 32, "learning_rate": 1e-3}
    config = PretrainConfig.of("paper", method=method, **(small | settings))
    seed_networks(0, "ball")
    target = build_target(config, dataset.action_after(dataset.transition_rows).numpy())
    objective = build_objective(config, 2, target, None, (3 * FRAME_STACK, SIZE))
    return Trainer(objective, make_batches(dataset, config, objective), config)


@torch.no_grad()
def position_error(trainer: Trainer) -> float:
    """Probe error of the ball's position in unshifted images of held-out episodes, % of its standard deviation."""
    dataset = trainer.batches.view.dataset
    features = trainer.objective.encoder.frame(View(dataset).stacks(torch.arange(dataset.num_rows)))
    return probe_error(features.numpy(), dataset.physics, dataset.episode.numpy())
