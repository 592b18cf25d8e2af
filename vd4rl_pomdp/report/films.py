"""Pictures of evaluation episodes: a strip that can be printed, and a moving picture."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from PIL import Image

from vd4rl_pomdp.report.facts import title
from vd4rl_pomdp.report.load import LoadedRun
from vd4rl_pomdp.runs import FILM_FILE

STRIP_FRAMES = 8
"""Frames in a film strip, at most."""
MOST_BYTES = 5 * 2**20
"""Of all pictures in a page, as text; films beyond it are left out."""
Film = dict[str, np.ndarray]


class Shown(NamedTuple):
    """A film as the page carries it."""

    title: str
    strip: str
    """PNG in base64."""
    movie: str
    """Animated WebP in base64."""
    share: float
    """Of the page's width that the strip takes."""
    total: float
    """Return of the episode."""


def shown_films(runs: Iterable[LoadedRun]) -> tuple[list[Shown], int]:
    """The film of the first seed of every method and setting, each read once, and how many found no room."""
    chosen: dict[tuple[str, ...], LoadedRun] = {}
    for run in runs:
        if run.rows and run.result.folder and (run.path / FILM_FILE).exists():
            chosen.setdefault(run.identity[:-1], run)
    shown, size = [], 0
    for run in chosen.values():
        film = run.film()
        name = f"{title(run)}, seed {run.labels['seed']}"
        made = Shown(name, _base64(strip(film)), _base64(movie(film)), _share(film), film["return"][-1])
        size += len(made.strip) + len(made.movie)
        if size > MOST_BYTES:
            break
        shown.append(made)
    return shown, len(chosen) - len(shown)


def _share(film: Film) -> float:
    return min(1.0, len(film["clean"]) / STRIP_FRAMES)


def strip(film: Film) -> bytes:
    """PNG film strip: clean frames above, the frames of the corrupted stacks (oldest to newest) below."""
    chosen = np.unique(np.linspace(0, len(film["clean"]) - 1, STRIP_FRAMES).astype(int))
    stacks = film["corrupted"][chosen].reshape(len(chosen), -1, 3, *film["corrupted"].shape[-2:])
    rows = [film["clean"][chosen], *stacks.swapaxes(0, 1)]
    return _png(np.concatenate([np.concatenate(list(_spaced(row)), axis=1) for row in rows], axis=0))


def _spaced(images: np.ndarray) -> Iterator[np.ndarray]:
    """(N, 3, H, W) -> images (H + 2, W + 2, 3) with a white border."""
    for image in images:
        yield np.pad(image.transpose(1, 2, 0), ((1, 1), (1, 1), (0, 0)), constant_values=255)


def movie(film: Film) -> bytes:
    """Animated WebP of an episode: clean at the left, the newest corrupted frame at the right."""
    newest = film["corrupted"][:, -3:]
    pairs = np.concatenate([film["clean"], newest], axis=3).transpose(0, 2, 3, 1)
    size = (pairs.shape[2] * 2, pairs.shape[1] * 2)
    frames = [Image.fromarray(pair).resize(size, Image.Resampling.NEAREST) for pair in pairs]
    buffer = io.BytesIO()
    frames[0].save(buffer, "WEBP", save_all=True, append_images=frames[1:], duration=80, loop=0, quality=60)
    return buffer.getvalue()


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
