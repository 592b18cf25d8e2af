"""The four mazes of the navigation experiment: names, curtains, and what a state's numbers are.

Distances are PointMaze's: a cell is 1 wide, the maze spans [-2.5, 2.5] in x and y, free cells form a U open to the
left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vd4rl_pomdp.errors import UserError

MOST_STEPS = 1000
"""Most simulator steps for one action: ten seconds."""
PICTURE_SIZE = 100
"""Height and width of a picture."""
FREE_CELLS = ((1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1))
"""Rows and columns of the 5x5 map's free cells, along the U."""
HALF_SIZE = 2.5
"""The maze's outer walls are at -2.5 and 2.5, its upper left cell is row 0 and column 0."""
BALL_RADIUS = 0.2
"""Radius of the ball that is drawn (PointMaze's site); the one that collides has a radius of 0.1."""
_PARALLAX = 0.03
"""Largest shift of a curtain's edge in the picture by perspective."""


@dataclass(frozen=True)
class Curtain:
    """A flat box over the maze: centre and half extents in x and y."""

    center: tuple[float, float]
    half: tuple[float, float]


@dataclass(frozen=True)
class MazeSpec:
    """One of the mazes."""

    name: str
    curtains: tuple[Curtain, ...] = ()
    first_person: bool = False

    @property
    def gym_id(self) -> str:
        """Gymnasium's id."""
        return f"vd4rl_pomdp/Maze{self.name.title().replace('_', '')}-v0"

    @property
    def position(self) -> list[int]:
        """Entries of a state that are the position."""
        return [0, 1]

    @property
    def velocity(self) -> list[int]:
        """Entries of a state that are the velocity: a state is qpos, then qvel."""
        return [3, 4] if self.first_person else [2, 3]

    def hidden(self, states: np.ndarray) -> np.ndarray:
        """Whether a curtain covers the whole ball: (..., P) states -> (...,) bool."""
        reach = BALL_RADIUS + _PARALLAX
        covered = np.zeros(states.shape[:-1], bool)
        for curtain in self.curtains:
            away = np.abs(states[..., :2] - curtain.center)
            covered |= (away <= np.array(curtain.half) - reach).all(-1)
        return covered


_RIGHT = Curtain((1.0, 0.0), (0.65, 0.6))
_TOP, _BOTTOM = Curtain((-0.25, 1.0), (0.65, 0.65)), Curtain((-0.25, -1.0), (0.65, 0.65))

MAZES = {
    spec.name: spec
    for spec in (
        MazeSpec("no_curtain"),
        MazeSpec("one_curtain", (_RIGHT,)),
        MazeSpec("three_curtains", (_TOP, _RIGHT, _BOTTOM)),
        MazeSpec("first_person", first_person=True),
    )
}


def get_maze(name: str) -> MazeSpec:
    """The maze called `name`; raises UserError listing the choices for an unknown one."""
    if name not in MAZES:
        raise UserError(f"unknown maze {name!r}: choose one of {', '.join(MAZES)}")
    return MAZES[name]


def check_maze(name: str) -> None:
    """Raise UserError unless a maze is called `name`."""
    get_maze(name)
