"""What a foreign format is to `data import` and `data export`: a reader of episodes, and where one can be, a writer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.shards import EpisodeArrays


@dataclass(frozen=True)
class SourceSet:
    """An opened set, whose episodes are read one at a time."""

    episodes: int
    rows: int
    """Rows in all, or about as many: they decide how many episodes a shard gets."""
    frame_shape: tuple[int, int]
    """Height and width of the pictures."""
    read: Callable[[int], Iterator[EpisodeArrays]]
    """Yields the rows of all episodes from a number on, as `rows_of` makes them, but for pictures of any height and
    width, and actions in the source's own units."""
    record: dict[str, Any]
    """JSON values that tell this source from another, its name first, such as size: a cut import goes on only with
    equal ones."""
    action_low: np.ndarray | None = None
    action_high: np.ndarray | None = None
    """(A,) bounds of the actions; None where nothing tells them: then they must lie in [-1, 1]."""
    task: str | None = None
    quality: str | None = None
    notes: list[str] = field(default_factory=list)
    """What a user must know of it, one line each."""


@dataclass(frozen=True)
class DataFormat:
    """A format of other libraries."""

    summary: str
    """One line that says what it is."""
    read: Callable[[str, str | None], SourceSet]
    """Opens a source: its path or name, and which of its observations holds the pictures (None: the only one)."""
    write: Callable[[Path, Path, SourceSet], list[str]] | None = None
    """Writes a set into a folder that is not there yet, and that will be renamed to the second: (folder, final place,
    set). Pictures are square, actions in [-1, 1]. Returns what the format could not keep, one line each."""


def rows_of(
    frames: np.ndarray,
    action: np.ndarray,
    reward: np.ndarray,
    terminated: bool,
    complete: bool = True,
    physics: np.ndarray | None = None,
) -> EpisodeArrays:
    """An episode whose a_t and r_t are numbered like the o_t that they follow, as rows, which hold a_{t-1} and r_{t-1}.

    Args:
        frames: (T + 1, 3, H, W) uint8, o_0 to o_T.
        action: (T, A), a_0 to a_{T-1}.
        reward: (T,).
        terminated: whether the task itself ended: the last discount is 0, and 1 after a time limit.
        complete: whether the episode ended at all; False: its source was cut.
        physics: (T + 1, P) simulator states.
    """
    steps = len(action)
    if len(frames) != steps + 1 or len(reward) != steps:
        raise UserError(
            f"has {len(frames)} pictures, {steps} actions and {len(reward)} rewards, expected one picture more"
        )
    discount, step_type = np.ones(steps + 1), np.full(steps + 1, StepType.MID, np.int64)
    step_type[0] = StepType.FIRST
    if complete and steps:
        step_type[-1], discount[-1] = StepType.LAST, not terminated
    return {
        "observation": frames,
        "action": np.concatenate([np.zeros_like(action[:1], shape=(1, *action.shape[1:])), action]),
        "reward": np.concatenate([[0.0], reward]),
        "discount": discount,
        "step_type": step_type,
        **({} if physics is None else {"physics": physics}),
    }


def one_hot(action: np.ndarray, number: int) -> np.ndarray:
    """(T,) actions from 0 to number - 1 as (T, number) float32: 1 for the one that was taken, -1 for all others."""
    return np.where(np.arange(number) == action[:, None], np.float32(1), np.float32(-1))


def picture_axes(shape: tuple[int, ...]) -> tuple[bool, int]:
    """Whether a picture's channels come last, and how many they are; UserError for a shape that is no picture's.

    Height and width are no channels: 1, 3, or 3 for each frame of a stack.
    """
    for last, channels in ((True, shape[-1]), (False, shape[0])) if len(shape) == 3 else ():
        if channels == 1 or (channels % 3 == 0 and channels <= 12):
            return last, channels
    if len(shape) == 2:
        return True, 0
    raise UserError(f"observations of shape {shape} are no pictures: (H, W), (H, W, 3) or (3, H, W) are")


def as_frames(pictures: np.ndarray) -> np.ndarray:
    """(T, ...) uint8 pictures of any layout that `picture_axes` tells as (T, 3, H, W): of a stack the newest frame."""
    last, channels = picture_axes(pictures.shape[1:])
    if not channels:
        pictures = pictures[..., None]
    frames = np.moveaxis(pictures, -1, 1) if last else pictures
    return np.repeat(frames, 3, axis=1) if frames.shape[1] == 1 else frames[:, -3:]


def library(name: str, extra: str) -> Any:
    """A module that only one format needs; UserError, naming the extra that brings it, if it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise UserError(
            f"this format needs {name.partition('.')[0]} ({error}): `pip install '.[{extra}]'` in the package's folder"
        ) from error
