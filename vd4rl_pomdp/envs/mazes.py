"""The mazes of the navigation experiment: names, how each is built, seen and driven, what a state's numbers are.

Distances are PointMaze's: a cell is 1 wide, the maze spans [-2.5, 2.5] in x and y, free cells form a U open to the
left. The first four are built like the paper's: the numbers are those of the generator that one of its authors
published (a fork of D4RL, github.com/bennevans/D4RL), also those of actions, where the paper's text has Gaussian noise.
The others are variants of them under names of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vd4rl_pomdp.core.errors import refuse_unknown

ACTION_REPEAT = 5
"""Simulator steps of 0.01 s for one action."""
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
Sky = Literal["none", "stars", "compass"]
"""Black; a vertical gradient with white stars; or colours that go once around the horizon."""


@dataclass(frozen=True)
class Curtain:
    """A flat box over the maze: centre and half extents in x and y."""

    center: tuple[float, float]
    half: tuple[float, float]


@dataclass(frozen=True)
class Style:
    """How mazes of one kind are built, seen and driven. Heights: the floor is at -0.1, the ball's centre at 0."""

    walls: tuple[float, float] = (-0.2, 0.2)
    """Bottom and top of the walls."""
    curtains: tuple[float, float] = (0.3, 0.7)
    """Bottom and top of the curtains."""
    curtain_color: tuple[float, float, float] = (0.7, 0.5, 0.3)
    """By default the walls' colour."""
    camera_height: float = 7.0
    camera_fovy: float = 30.0
    """Degrees; the camera hangs over the centre and looks down."""
    hidden_reach: float = 1.03 * BALL_RADIUS
    """How far from its centre the ball may be seen from above, perspective included."""
    hidden_within: float = 1.5
    """The outer walls' faces: what of the ball lies behind them no curtain need hide."""
    eye_height: float = 0.0
    eye_fovy: float = 60.0
    """Height above the ball's centre, and degrees, of the first person's camera."""
    sky: Sky = "stars"
    """What the first person sees above the walls."""
    turning_rate: float = 40.0
    """First person: radians/s that an action of 1 sets."""
    heading_damping: float = 2.48
    """Leaves 0.403 of the turning rate after each simulator step: 0.27 radians for 5 steps and an action of 1."""
    push: float | None = 0.1
    """First person: change of velocity for an action of 1, once a decision; None: what 10 units/s^2 come to in it."""
    limited_every_step: bool = False
    """Velocities are limited to 5 before every simulator step, as PointMaze does, or once a decision."""
    goal_radius: float = 0.1
    goal_travel: float = 0.1
    """A goal is reached within this distance by a mass that has moved less than this in the last decision."""
    goal_decisions: int = 150
    """Decisions after which another goal is drawn anyway; 0 for never."""
    goal_margin: float = 0.1
    """Goals are uniform where the mass has this much room."""
    goals_are_cells: bool = True
    """A goal is the point of its cell that the planner heads for."""
    noise: float = 0.0
    """Standard deviation of Gaussian noise on every action of the data."""
    zero_share: float = 0.1
    random_share: float = 0.1
    """Shares of the data's actions that are zero, and uniformly random."""


SOURCE = Style()
"""From the top, as the paper's data was made."""
_FIRST_PERSON = replace(SOURCE, goal_radius=0.5, goal_travel=np.inf, goals_are_cells=False)
"""In first person, likewise."""
HARD = Style(
    walls=(0.0, 0.4),
    curtains=(0.4, 0.5),
    curtain_color=(0.25, 0.25, 0.35),
    camera_height=40.0,
    camera_fovy=float(np.degrees(2 * np.arctan(2.5 / 39.6))),
    hidden_reach=BALL_RADIUS + 0.03,
    hidden_within=np.inf,
    eye_height=0.15,
    eye_fovy=75.0,
    sky="none",
    turning_rate=4.0,
    heading_damping=0.0,
    push=None,
    limited_every_step=True,
    goal_radius=0.2,
    goal_travel=np.inf,
    goal_decisions=0,
    goal_margin=0.0,
    goals_are_cells=False,
    noise=0.5,
    zero_share=0.0,
    random_share=0.0,
)
"""Wide curtains under a camera far above, a black sky, and noise on every action."""


@dataclass(frozen=True)
class MazeSpec:
    """One of the mazes."""

    name: str
    paper: str
    """The maze of the paper that this is, or is a variant of."""
    curtains: tuple[Curtain, ...] = ()
    style: Style = SOURCE

    @property
    def gym_id(self) -> str:
        """Gymnasium's id."""
        return f"vd4rl_pomdp/Maze{self.name.title().replace('_', '')}-v0"

    @property
    def driver(self) -> str:
        """What drives in its data: ppo, or planner."""
        return "ppo" if self.first_person else "planner"

    @property
    def first_person(self) -> bool:
        """Whether it is seen through the mass's own eyes; a state then has a heading."""
        return self.paper == "first_person"

    @property
    def position(self) -> list[int]:
        """Entries of a state that are the position."""
        return [0, 1]

    @property
    def velocity(self) -> list[int]:
        """Entries of a state that are the velocity: a state is qpos, then qvel."""
        return [3, 4] if self.first_person else [2, 3]

    def hidden(self, states: np.ndarray) -> np.ndarray:
        """Whether a curtain covers all that could be seen of the ball: (..., P) states -> (...,) bool."""
        reach, within, height = self.style.hidden_reach, self.style.hidden_within, self.style.camera_height
        # how much larger than themselves a curtain's lower and upper faces appear at the ball's height
        shadows = [1.0] if np.isinf(within) else [height / (height - z) for z in self.style.curtains]
        low, high = (np.clip(states[..., :2] + side, -within, within) for side in (-reach, reach))
        covered = np.zeros(states.shape[:-1], bool)
        for curtain in self.curtains:
            for scale in shadows:
                center, half = scale * np.array(curtain.center), scale * np.array(curtain.half)
                covered |= ((low >= center - half) & (high <= center + half)).all(-1)
        return covered


_BEND = Curtain((1.0, 0.0), (0.5, 0.5))
_ENDS = Curtain((-1.0, 1.0), (0.5, 0.5)), Curtain((-1.0, -1.0), (0.5, 0.5))
_RIGHT = Curtain((1.0, 0.0), (0.65, 0.6))
_TOP, _BOTTOM = Curtain((-0.25, 1.0), (0.65, 0.65)), Curtain((-0.25, -1.0), (0.65, 0.65))

PAPER_MAZES = ("no_curtain", "one_curtain", "three_curtains", "first_person")
"""The mazes of the paper's tables."""
MAZES = {
    spec.name: spec
    for spec in (
        MazeSpec("no_curtain", "no_curtain"),
        MazeSpec("one_curtain", "one_curtain", (_BEND,)),
        MazeSpec("three_curtains", "three_curtains", (_ENDS[0], _BEND, _ENDS[1])),
        MazeSpec("first_person", "first_person", style=_FIRST_PERSON),
        MazeSpec("compass_first_person", "first_person", style=replace(_FIRST_PERSON, sky="compass")),
        MazeSpec("hard_no_curtain", "no_curtain", style=HARD),
        MazeSpec("hard_one_curtain", "one_curtain", (_RIGHT,), HARD),
        MazeSpec("hard_three_curtains", "three_curtains", (_TOP, _RIGHT, _BOTTOM), HARD),
        MazeSpec("hard_first_person", "first_person", style=HARD),
    )
}


def get_maze(name: str) -> MazeSpec:
    """The maze called `name`; raises UserError listing the choices for an unknown one."""
    refuse_unknown("maze", name, MAZES)
    return MAZES[name]
