"""Interface of formats for `data import` and `data export`: a reader of episodes and, optionally, a writer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
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
    """An opened data set whose episodes are read one at a time."""

    lengths: list[int]
    """Rows of every episode."""
    frame_shape: tuple[int, int]
    """Height and width of the pictures."""
    read: Callable[[int], Iterator[EpisodeArrays]]
    """Yields the rows of all episodes from a given number on, as by `rows_of`, but with images of any height and width,
    and actions in the source's own units."""
    record: dict[str, Any]
    """JSON values that identify the source, name first, such as its size; an interrupted import resumes only if they
    are equal."""
    action_low: np.ndarray | None = None
    action_high: np.ndarray | None = None
    """(A,) action bounds; None if unknown: actions must then lie in [-1, 1]."""
    task: str | None = None
    quality: str | None = None
    notes: list[str] = field(default_factory=list)
    """Warnings for the user, one line each."""


@dataclass(frozen=True)
class DataFormat:
    """A data format of another library."""

    summary: str
    """One-line description."""
    read: Callable[[str, str | None], SourceSet]
    """Opens a source, given its path or name and the observation that holds the images (None: the only one)."""
    write: Callable[[Path, Path, SourceSet], list[str]] | None = None
    """Called with (folder, final place, set): writes the set to a new folder, which is then renamed to the final place.
    Images are square, actions in [-1, 1]. Returns what the format could not store, one line each."""


def rows_of(
    frames: np.ndarray,
    action: np.ndarray,
    reward: np.ndarray,
    terminated: bool | np.ndarray,
    complete: bool = True,
    physics: np.ndarray | None = None,
) -> EpisodeArrays:
    """Convert an episode with a_t and r_t beside o_t to this package's rows, which store a_{t-1} and r_{t-1}.

    Args:
        frames: (T + 1, 3, H, W) uint8, o_0 to o_T.
        action: (T, A), a_0 to a_{T-1}.
        reward: (T,).
        terminated: whether the task terminated (discount 0; 1 after a time limit): at the last step, or (T,) per step.
        complete: whether the episode ended at all; False: the recording was cut off.
        physics: (T + 1, P) simulator states.
    """
    steps = len(action)
    ended = terminated if isinstance(terminated, np.ndarray) else terminated & (np.arange(1, steps + 1) == steps)
    counts = {"images after the first": len(frames) - 1, "rewards": len(reward), "terminations": len(ended)}
    for name, count in (counts | ({} if physics is None else {"states after the first": len(physics) - 1})).items():
        if count != steps:
            raise UserError(f"has {steps} actions, but {count} {name}")
    step_type = np.full(steps + 1, StepType.MID, np.int64)
    step_type[0] = StepType.FIRST
    if complete and steps:
        step_type[-1] = StepType.LAST
    return {
        "observation": frames,
        "action": np.concatenate([np.zeros_like(action[:1], shape=(1, *action.shape[1:])), action]),
        "reward": np.concatenate([[0.0], reward]),
        "discount": np.append(1.0, 1.0 - ended),
        "step_type": step_type,
        **({} if physics is None else {"physics": physics}),
    }


def one_hot(action: np.ndarray, number: int) -> np.ndarray:
    """Encode (T,) discrete actions in 0..number-1 as (T, number) float32: 1 for the action taken, -1 for the others."""
    return np.where(np.arange(number) == action[:, None], np.float32(1), np.float32(-1))


_CHANNELS = (1, 3, 6, 9, 12)
"""Valid channel counts: grey, or RGB times up to 4 stacked frames."""
_GREY_STACK = 4
"""Also valid before height and width: Atari's four grey frames. Behind them it could be RGB with transparency."""


def picture_size(shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Height and width of a picture (H, W), (H, W, C) or (C, H, W), or of a stack (S, H, W, C) or (S, C, H, W) of them;
    None for other shapes."""
    shape = shape[1:] if len(shape) == 4 else shape
    if len(shape) == 2 or (len(shape) == 3 and shape[2] in _CHANNELS):
        return shape[0], shape[1]
    return (shape[1], shape[2]) if len(shape) == 3 and shape[0] in (*_CHANNELS, _GREY_STACK) else None


def as_frames(pictures: np.ndarray) -> np.ndarray:
    """Convert (T, ...) uint8 images, of shapes that `picture_size` accepts, to (T, 3, H, W); newest frame of stacks."""
    if pictures.ndim == 5:
        pictures = pictures[:, -1]
    elif pictures.ndim == 3:
        pictures = pictures[..., None]
    frames = np.moveaxis(pictures, -1, 1) if pictures.shape[-1] in _CHANNELS else pictures
    return np.repeat(frames[:, -1:], 3, axis=1) if frames.shape[1] in (1, _GREY_STACK) else frames[:, -3:]


def chosen(shapes: Mapping[str, tuple[int, ...]], picture: str | None) -> tuple[str, tuple[int, int]]:
    """Name and image size of one of the uint8 observations with `shapes`: of `picture`, else of the only candidate."""
    known = {name: size for name, shape in shapes.items() if (size := picture_size(shape))}
    if not known:
        raise UserError(
            "holds no images: expected uint8 observations of shape (H, W), (H, W, 3) or (3, H, W), or stacks of them"
        )
    if picture in known or (picture is None and len(known) == 1):
        return next((name, size) for name, size in known.items() if picture in (name, None))
    raise UserError(f"has several image observations: choose one with --picture, of {', '.join(known)}")


def library(name: str, extra: str) -> Any:
    """Import a format's optional dependency; UserError naming the extra to install if it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise UserError(
            f"this format needs {name.partition('.')[0]} ({error}): `pip install '.[{extra}]'` in the package's folder"
        ) from error
