"""A film of a held-out trajectory: where the mass is, and where a probe on frozen states takes it to be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from vd4rl_pomdp.envs.mazes import BALL_RADIUS, FREE_CELLS, HALF_SIZE, MazeSpec
from vd4rl_pomdp.studies.navigation.runs import read_trajectory

SIDE, HEAD = 240, 22
"""Pixels of a panel's maze, and of the line above it."""
_FINE = 2
_SHOWN = 1.75
"""How far from the centre is shown: the free cells, and some of the walls around them."""
_MILLISECONDS = 80
"""Of a frame: a little slower than the mass is."""
_WALL, _FLOOR, _PAPER, _INK = (228, 201, 168), (58, 82, 110), (255, 255, 255), (30, 30, 30)
_CURTAIN, _TRUE, _ESTIMATE = (200, 140, 85, 165), (90, 200, 90), (255, 90, 0)


def write_film(trajectories: Mapping[str, Path], maze: MazeSpec, path: Path) -> None:
    """Write an animated GIF with one panel for each name.

    The true mass is a green disc, under curtains as one sees through them here; the estimate is an orange ring.

    Args:
        trajectories: `trajectory.csv` of runs on that maze, by what to write above them.
        maze: whose walls and curtains are drawn.
        path: the file.
    """
    tables = {name: read_trajectory(file) for name, file in trajectories.items()}
    ground = _ground(maze)
    frames = [
        _join([_panel(name, table, row, maze, ground) for name, table in tables.items()])
        for row in range(min(len(table["x"]) for table in tables.values()))
    ]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=_MILLISECONDS, loop=0)


def to_pixels(x: float, y: float) -> tuple[float, float]:
    """Column and row within a panel of a position in the maze."""
    return (x + _SHOWN) / (2 * _SHOWN) * SIDE, HEAD + (_SHOWN - y) / (2 * _SHOWN) * SIDE


def _panel(name: str, table: Mapping[str, np.ndarray], row: int, maze: MazeSpec, ground: Image.Image) -> Image.Image:
    """One method's maze at one moment."""
    image = ground.copy()
    draw = ImageDraw.Draw(image, "RGBA")
    draw.ellipse(_around(table["x"][row], table["y"][row], BALL_RADIUS), fill=_TRUE)
    for curtain in maze.curtains:
        (x, y), (half_x, half_y) = curtain.center, curtain.half
        corners = to_pixels(x - half_x, y + half_y), to_pixels(x + half_x, y - half_y)
        draw.rectangle([_FINE * number for corner in corners for number in corner], fill=_CURTAIN)
    at = table["estimated_x"][row], table["estimated_y"][row]
    draw.ellipse(_around(*at, BALL_RADIUS), outline=_ESTIMATE, width=3 * _FINE)
    small = image.resize((SIDE, SIDE + HEAD), Image.Resampling.LANCZOS)
    ImageDraw.Draw(small).text((6, 5), f"{name}: mass and estimate", fill=_INK)
    return small


def _ground(maze: MazeSpec) -> Image.Image:
    """The maze without the mass, finer than it is shown."""
    image = Image.new("RGB", (SIDE * _FINE, (SIDE + HEAD) * _FINE), _PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, HEAD * _FINE, SIDE * _FINE, (SIDE + HEAD) * _FINE], fill=_WALL)
    for row, column in FREE_CELLS:
        corners = [to_pixels(column - HALF_SIZE + i, HALF_SIZE - row - i) for i in (0, 1)]
        draw.rectangle([_FINE * number for corner in corners for number in corner], fill=_FLOOR)
    return image


def _around(x: float, y: float, radius: float) -> list[float]:
    (left, top), (right, bottom) = to_pixels(x - radius, y + radius), to_pixels(x + radius, y - radius)
    return [_FINE * number for number in (left, top, right, bottom)]


def _join(panels: list[Image.Image]) -> Image.Image:
    """Panels side by side."""
    joined = Image.new("RGB", (sum(panel.width for panel in panels), panels[0].height), _PAPER)
    for number, panel in enumerate(panels):
        joined.paste(panel, (number * panel.width, 0))
    return joined
