"""Renders films of evaluation episodes as still strips and as animations."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vd4rl_pomdp.core.reading import damaged, read_bytes
from vd4rl_pomdp.report.load import CONDITION, Run, title
from vd4rl_pomdp.runs import FILM_FILE
from vd4rl_pomdp.runs.files import Row

FILM = {"clean": 4, "corrupted": 4, "return": 1}  # arrays of a film and their number of dimensions
STRIP_FRAMES = 8  # maximum frames in a film strip
MOST_BYTES = 5 * 2**20  # maximum size of all films in a page, in base64; further films are left out
Film = dict[str, np.ndarray]


def read_film(path: Path) -> Film:
    """Frames of an evaluation episode; UserError for a damaged file."""
    with damaged(path, "cannot be read", "remove it, and the report goes without"):
        with np.load(io.BytesIO(read_bytes(path))) as file:
            film = dict(file)
        clean, corrupted, returns = shapes = [film[name].shape for name in FILM]
        fit = list(map(len, shapes)) == list(FILM.values()) and len({shape[0] for shape in shapes}) == 1
        if not fit or not returns[0] or clean[1:] != (3, *corrupted[2:]) or corrupted[1] % 3:
            raise ValueError("its arrays have other shapes")
        return film


def shown_films(runs: Iterable[Run]) -> tuple[list[Row], int]:
    """The first seed's film for every method and setting, and the number of films that did not fit.

    Keys: `title`; `strip` (PNG) and `movie` (animated WebP), both in base64; `share`, the strip's fraction of the page
    width; `total`, the episode's return.
    """
    chosen: dict[tuple, Run] = {}
    for run in runs:
        if run.rows and run.result.folder and (run.result.path / FILM_FILE).exists():
            chosen.setdefault(run.of(CONDITION), run)
    shown, size = [], 0
    for run in chosen.values():
        film = read_film(run.result.path / FILM_FILE)
        still, moving = (base64.b64encode(picture).decode() for picture in (_strip(film), _movie(film)))
        size += len(still) + len(moving)  # everything is embedded, as the page must open from disk
        if size > MOST_BYTES:
            break
        made: Row = {"title": f"{title(run)}, seed {run.labels['seed']}", "strip": still, "movie": moving}
        shown.append(made | {"share": min(1.0, len(film["clean"]) / STRIP_FRAMES), "total": film["return"][-1]})
    return shown, len(chosen) - len(shown)


def _strip(film: Film) -> bytes:
    """PNG film strip: clean frames above, the frames of the corrupted stacks (oldest to newest) below."""
    chosen = np.unique(np.linspace(0, len(film["clean"]) - 1, STRIP_FRAMES).astype(int))
    stacks = film["corrupted"][chosen].reshape(len(chosen), -1, 3, *film["corrupted"].shape[-2:])
    rows = np.stack([film["clean"][chosen], *stacks.swapaxes(0, 1)]).transpose(0, 1, 3, 4, 2)
    framed = np.pad(rows, ((0, 0), (0, 0), (1, 1), (1, 1), (0, 0)), constant_values=255)
    frames, height, width = framed.shape[1:4]
    image = framed.swapaxes(1, 2).reshape(len(rows) * height, frames * width, 3)
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _movie(film: Film) -> bytes:
    """Animated WebP of an episode: clean frame on the left, newest corrupted frame on the right."""
    newest = film["corrupted"][:, -3:]
    pairs = np.concatenate([film["clean"], newest], axis=3).transpose(0, 2, 3, 1)
    size = (pairs.shape[2] * 2, pairs.shape[1] * 2)
    return _webp([Image.fromarray(pair).resize(size, Image.Resampling.NEAREST) for pair in pairs], 60)


def side_by_side(names: Sequence[str], films: Sequence[Film]) -> bytes:
    """Animated WebP of several agents in one episode, a named row each: the scene, then the stack that the agent sees.

    Stacks are shown oldest frame first; an episode that ended early freezes.
    """
    frames = []
    for shot in range(max(len(film["clean"]) for film in films)):
        rows = [_row(name, film, min(shot, len(film["clean"]) - 1)) for name, film in zip(names, films, strict=True)]
        wide = max(row.shape[1] for row in rows)  # agents may see frames of different sizes
        rows = [np.pad(row, ((0, 0), (0, wide - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
        frames.append(Image.fromarray(np.concatenate(rows)))
    return _webp(frames, 70)


def _webp(frames: Sequence[Image.Image], quality: int) -> bytes:
    """Animated WebP at 12.5 frames a second that repeats forever."""
    buffer = io.BytesIO()
    frames[0].save(buffer, "WEBP", save_all=True, append_images=frames[1:], duration=80, loop=0, quality=quality)
    return buffer.getvalue()


def _row(name: str, film: Film, shot: int) -> np.ndarray:
    """One agent's row at one moment, (H, W, 3) uint8."""
    stack = film["corrupted"][shot]
    pictures = np.stack([film["clean"][shot], *stack.reshape(-1, 3, *stack.shape[1:])]).transpose(0, 2, 3, 1)
    large = pictures.repeat(2, axis=1).repeat(2, axis=2)
    framed = np.pad(large, ((0, 0), (22, 4), (2, 2), (0, 0)), constant_values=255)
    image = Image.fromarray(np.concatenate([*framed], axis=1))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    draw.text((4, 2), f"{name}: return {film['return'][shot]:.0f}", fill="black", font=font)
    draw.text((framed.shape[2] + 4, 2), "what it sees: frames of the stack, oldest first", fill="gray", font=font)
    return np.asarray(image)
