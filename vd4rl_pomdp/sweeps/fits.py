"""Whether the trainings of a cell fit the set that it collects, which can be known before there is one.

A stage refuses the same once it has read its set; a sweep would have collected it, and trained on it, in vain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

from vd4rl_pomdp.core.errors import UserError, refuse_outside
from vd4rl_pomdp.core.tasks import FRAME_STACK, TASKS, GymnasiumTask
from vd4rl_pomdp.corruptions import check_corruption_fits
from vd4rl_pomdp.nn.encoder import EncoderConfig, build_frame_encoder
from vd4rl_pomdp.nn.frame import STATE, encoder_settings


def check_fit(configs: Mapping[str, Any]) -> None:
    """Raise UserError for frames or episodes that a training of a cell cannot read.

    Args:
        configs: the settings of the cell's stages, by section.
    """
    configs = {section: replace(config, seed=0) for section, config in configs.items()}  # seeds do not matter here
    if (maze_set := configs.get("navigation_collect")) and (training := configs.get("navigation_train")):
        _check_maze(training, maze_set)
    if data_set := configs.get("collect"):
        size, rows = data_set.frame_size, TASKS.named(data_set.task).decisions + 1
        if before := configs.get("pretrain"):
            _check_states(before.method, data_set.task)
            _check_pretraining(before, size, rows)
        if after := configs.get("finetune"):
            _check_finetuning(after, size, rows)


@cache
def _check_maze(training: Any, maze_set: Any) -> None:
    from vd4rl_pomdp.studies.navigation.data import check_trajectories
    from vd4rl_pomdp.studies.navigation.pictures import SHAPES, check_source

    if training.exogenous != "none":
        check_source(training.exogenous)
    check_trajectories(maze_set.trajectories, "--trajectories is 1")
    _check_window(training.window, maze_set.trajectory_rows)
    _check_frames(training, *SHAPES[training.picture])


@cache
def _check_pretraining(config: Any, size: int, rows: int) -> None:
    from pretrain.objectives import METHODS

    refuse_outside(config, shift=(0, size - 1))
    check_corruption_fits(config.corruption, size)
    _check_window(config.window, rows)
    if not METHODS.named(config.method).reads_state and config.frame_encoder != STATE:
        _check_frames(config, 3 * FRAME_STACK, size)


def _check_states(method: str, task: str) -> None:
    from pretrain.objectives import METHODS

    part = METHODS.named(method)
    if (part.reads_state or part.regresses_state) and isinstance(TASKS.named(task), GymnasiumTask):
        raise UserError(f"{method} needs the simulator's states, and {task} has none: leave one of them out")


@cache
def _check_finetuning(config: Any, size: int, rows: int) -> None:
    from finetune.settings import check_n_step

    refuse_outside(config, shift=(0, size - 1))
    check_n_step(config, rows - 1)


def _check_window(window: int, rows: int) -> None:
    if window > rows:
        raise UserError(f"--window {window} is longer than an episode of the set, of {rows} rows: choose a shorter one")


def _check_frames(config: Any, channels: int, size: int) -> None:
    """Build the frame encoder, to see that it can be; its width plays no part."""
    told = encoder_settings(replace(config.frame, feature_dim=1))
    build_frame_encoder(EncoderConfig(0, config.frame_encoder, channels=channels, size=size, **told))
