"""Convert data sets from and to other formats, episode by episode: `data import` and `data export`.

An import writes shards like `data collect` and resumes if interrupted. An export is written to a hidden folder next to
the target and renamed at the end; an interrupted export starts over.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError, disk_errors, in_one_line, refuse_number, system_error
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_SIZES, TASKS, DMCTask
from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.core.types import WINDOW
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.data.folder import check_lengths
from vd4rl_pomdp.data.format import FRAMES_KEY, check_rows
from vd4rl_pomdp.data.formats import FORMATS
from vd4rl_pomdp.data.formats.base import SourceSet
from vd4rl_pomdp.data.formats.vd4rl import read_shards
from vd4rl_pomdp.data.shards import EpisodeArrays, Shard, collect_set
from vd4rl_pomdp.envs.gymnasium_task import area_means
from vd4rl_pomdp.runs.outputs import built, refuse_inside, removing_if_empty
from vd4rl_pomdp.runs.progress import ProgressLine

_SHARD_ROWS = 5_000
"""Approximate number of rows per shard, fewer if frames exceed 84 pixels; twice as many are in memory at once."""
_ROUNDING = 1e-5
"""Tolerance for actions beyond their bounds, for float32 rounding."""


def import_set(
    name: str,
    source: str,
    out: Path,
    task: str | None = None,
    quality: str | None = None,
    size: int | None = None,
    picture: str | None = None,
    clip_actions: bool = False,
    shortest: int = 1,
) -> list[Path]:
    """Convert a data set of another format to this package's, or only its missing shards; returns its shards.

    Args:
        name: name of the format in `FORMATS`.
        source: path or name of the data set.
        task: task name, if the source does not state it or to override it.
        size: height and width to resize images to, by area averaging; None: no resizing.
        picture: name of the observation that holds the images, if there are several.
        clip_actions: whether actions outside the source's bounds are clipped; otherwise they are refused.
        shortest: episodes of fewer rows are left out.
    """
    refuse_inside(out)
    refuse_number("shortest", shortest, 1)
    with _errors_of(source):
        stored = FORMATS.named(name).read(source, picture)
        opened = _resized(stored, size)
        numbers = [number for number, rows in enumerate(opened.lengths) if rows >= shortest]
        if not numbers:
            raise UserError(f"holds no episodes of {shortest} or more rows" if opened.lengths else "holds no episodes")
        check_lengths(source, opened.lengths)
    lengths = [opened.lengths[number] for number in numbers]
    own = next((value for value in opened.record.values() if isinstance(value, str)), name)
    # without a known task, its label (also used in file names) is made from the source's own name
    label = re.sub(r"[^\w.-]+", "_", task or opened.task or own).strip("._") or name
    _print([*opened.notes, *_about_lengths(lengths, len(opened.lengths) - len(lengths), shortest)])
    if opened.frame_shape != stored.frame_shape and isinstance(TASKS.get(label), DMCTask):
        means = f"evaluations render {label} at {size}x{size}, which gives other pixels than these means"
        _print([f"{means}: `vd4rl-pomdp data parity {out}` compares them"])
    rows = _SHARD_ROWS * FRAME_SIZE**2 // max(FRAME_SIZE, opened.frame_shape[0]) ** 2
    per_shard = max(1, rows * len(numbers) // sum(lengths))
    settings: dict[str, Any] = {
        "format": name,
        "source": opened.record,
        "episodes": len(numbers),
        "task": label,
        "set": quality or opened.quality,
        "frame_size": opened.frame_shape[0],
        "episodes_per_shard": per_shard,  # a resumed import must not add shards of another division
    }
    attributes = {key: settings[key] for key in ("task", "set") if settings[key]} | {
        "imported": {"format": name, **opened.record}
    }
    shards = [
        Shard(out / f"{start // per_shard}_{label}.hdf5", numbers[start : start + per_shard], attributes)
        for start in range(0, len(numbers), per_shard)
    ]
    episodes = _Reader(source, opened, clip_actions)
    with removing_if_empty(out):
        collect_set(out, settings, shards, episodes, 1, ("import", "episodes"), None)
    _print(episodes.notes())
    write_card(out)
    return [shard.path for shard in shards]


def export_set(name: str, path: Path, out: Path, size: int | None = None) -> None:
    """Convert a data set of this package to another format; `size` as in `import_set`."""
    form = FORMATS.named(name)
    if form.write is None:
        writable = [other for other, one in FORMATS.items() if one.write]
        raise UserError(f"the format {name!r} cannot be written: choose one of {', '.join(writable)}")
    opened = _resized(read_shards(str(path)), size)
    progress = ProgressLine("export", len(opened.lengths), "episodes")

    def read(first: int) -> Iterator[EpisodeArrays]:
        for rows in opened.read(first):
            yield rows
            progress.advance(1, ret=float(rows["reward"][1:].sum()))

    with disk_errors(out), built(out) as made, progress:
        lost = form.write(made, out, replace(opened, read=read))
    _print(lost)


@contextmanager
def _errors_of(place: str) -> Iterator[None]:
    """Turn errors of a format's reader or library into one-line UserErrors that name `place`."""
    try:
        yield
    except UserError as error:
        raise type(error)(str(error) if str(error).startswith(place) else f"{place}: {error}") from error
    except Exception as error:  # libraries do not validate their input, so damaged files raise anything
        raise system_error(Path(place), error) or UserError(
            f"{place}: cannot be read as this format ({in_one_line(error) or type(error).__name__})"
        ) from error


def _about_lengths(lengths: list[int], dropped: int, shortest: int) -> Iterator[str]:
    if dropped:
        yield f"{dropped} episodes of fewer than {shortest} rows are left out"
    short = [rows for rows in lengths if 1 < rows < WINDOW]  # single rows are in no window
    if short:
        yield (
            f"{len(short)} episodes are shorter than pretraining's default window of {WINDOW} rows: pretrain "
            f"with --window {min(short)}, or leave them out with --shortest {WINDOW}"
        )


class _Reader:
    """Returns an episode's rows by number, in increasing order."""

    def __init__(self, name: str, source: SourceSet, clip: bool) -> None:
        self._name, self._source, self._clip = name, source, clip
        self._next = -1
        self._episodes: Iterator[tuple[int, EpisodeArrays]] | None = None
        self._layout: dict[str, tuple[int, ...]] = {}
        self._last = np.zeros(0, np.uint8)  # last image of the previous episode
        self._clipped = self._steps = self._followed = self._joined = 0
        self._moved = False

    def __call__(self, number: int) -> EpisodeArrays:
        with _errors_of(f"{self._name}: episode {number}"):
            if self._episodes is None:
                self._episodes = enumerate(self._source.read(number), number)
            rows = next((rows for found, rows in self._episodes if found == number), None)
            if rows is None:
                raise UserError("is missing")
            frames, size = rows[FRAMES_KEY], self._source.frame_shape
            rows = rows | {"action": self._scaled(rows["action"])}
            if frames.shape[2:] != size:
                found, declared = (f"{height}x{width}" for height, width in (frames.shape[2:], size))
                raise UserError(f"has images of {found} pixels, its dataset declares {declared}")
            layout = {key: values.shape[1:] for key, values in rows.items()}
            if frames.dtype != np.uint8:
                raise UserError(f"has {frames.dtype} images, expected uint8")
            if layout != (self._layout or layout):
                raise UserError(f"has rows of {layout}, unlike the episodes before")
            self._layout = layout
            states = {key: values for key, values in rows.items() if key != FRAMES_KEY}
            check_rows(f"{self._name}: episode {number}", states, len(frames))
            self._steps += len(frames) - 1
            self._moved = self._moved or bool((frames[1:] != frames[0]).any())
            self._followed += number == self._next
            self._joined += number == self._next and np.array_equal(frames[0], self._last)
            self._next, self._last = number + 1, frames[-1].copy()
            return rows

    def notes(self) -> Iterator[str]:
        if self._clipped:
            yield f"{self._clipped} actions lay outside their bounds and were clipped"
        if self._steps and not self._moved:
            yield "in every episode all images are equal: did the recorder keep references to one buffer?"
        elif self._joined and self._joined == self._followed:
            yield "every episode begins with the last image of the one before: its first step crosses a reset"

    def _scaled(self, action: np.ndarray) -> np.ndarray:
        """Actions rescaled to [-1, 1]; a first row's stays zero."""
        low, high = self._source.action_low, self._source.action_high
        scaled = action.astype(np.float32)
        if low is not None and high is not None and not ((low == -1).all() and (high == 1).all()):
            share = (action.astype(np.float64) - low) / np.where(high > low, high - low, 1)
            scaled = (share * 2 - 1).astype(np.float32)
            scaled[0] = 0
        outside = (np.abs(scaled) > 1 + _ROUNDING).any(1)
        if outside.any() and not self._clip:
            bounds = "its bounds" if low is not None else "[-1, 1], and the source has no bounds"
            most = np.abs(scaled).max()
            raise UserError(f"has actions outside {bounds} (up to {most:.4g} after scaling); --clip-actions clips them")
        self._clipped += int(outside.sum())
        return scaled.clip(-1, 1)


def _resized(source: SourceSet, size: int | None) -> SourceSet:
    """The source with square frames, resized to `size` if given; UserError if frames are not square and it is not."""
    (height, width), (low, high) = source.frame_shape, FRAME_SIZES
    if size is None:
        if height != width or not low <= height <= high:
            raise UserError(
                f"has images of {height}x{width} pixels, frames must be square, of {low} to {high}: pass --size, "
                "such as --size 84"
            )
        return source
    refuse_number("size", size, low, high)
    if (height, width) == (size, size):
        return source

    def read(first: int) -> Iterator[EpisodeArrays]:
        for rows in source.read(first):
            small = [area_means(one.transpose(1, 2, 0), size).transpose(2, 0, 1) for one in rows[FRAMES_KEY]]
            yield rows | {FRAMES_KEY: np.stack(small)}

    stretched = "" if height == width else "; height and width are scaled separately"
    note = f"images of {height}x{width} pixels become {size}x{size} (area means{stretched})"
    return replace(source, read=read, frame_shape=(size, size), notes=[*source.notes, note])


def _print(notes: Iterable[str]) -> None:
    for note in notes:
        print(f"note: {one_line(note)}", file=sys.stderr)
