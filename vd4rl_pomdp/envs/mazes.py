"""The mazes of the navigation experiment: geometry, cameras, dynamics, goals, and the layout of states.

Units are PointMaze's: a cell is 1 wide, the maze spans [-2.5, 2.5] in x and y, and the free cells form a U open to the
left. The first four mazes are the paper's. Their parameters come from a generator that one of its authors published (a
fork of D4RL, github.com/bennevans/D4RL), including those of actions, where the paper's text has Gaussian noise instead.
The other mazes are variants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vd4rl_pomdp.core.errors import refuse_unknown

ACTION_REPEAT = 5
"""Simulator steps, of 0.01 s, per action."""
MOST_STEPS = 1000
"""Largest action repeat: ten seconds."""
PICTURE_SIZE = 100
"""Height and width of an image."""
FREE_CELLS = ((1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1))
"""(row, column) of the free cells of the 5x5 map, in order along the U."""
HALF_SIZE = 2.5
"""The maze spans -2.5 to 2.5; its upper left cell is (0, 0)."""
BALL_RADIUS = 0.2
"""Radius of the visible ball (PointMaze's site); the collision radius is 0.1."""
Sky = Literal["none", "stars", "compass"]
"""Black, a vertical gradient with white stars, or the colour wheel around the horizon."""


@dataclass(frozen=True)
class Curtain:
    """A flat box over the maze: centre and half extents in x and y."""

    center: tuple[float, float]
    half: tuple[float, float]


@dataclass(frozen=True)
class Style:
    """Parameters of a family of mazes. Heights: the floor is at -0.1, the ball's centre at 0."""

    walls: tuple[float, float] = (-0.2, 0.2)
    """Bottom and top of the walls."""
    curtains: tuple[float, float] = (0.3, 0.7)
    """Bottom and top of the curtains."""
    curtain_color: tuple[float, float, float] = (0.7, 0.5, 0.3)
    """By default the walls' colour."""
    camera_height: float = 7.0
    camera_fovy: float = 30.0
    """Field of view in degrees; the camera is above the centre and looks down."""
    hidden_reach: float = 1.03 * BALL_RADIUS
    """Radius of the ball as seen from above, perspective included."""
    hidden_within: float = 1.5
    """The outer walls' inner faces, at +-1.5: the part of the ball beyond them is hidden anyway."""
    eye_height: float = 0.0
    eye_fovy: float = 60.0
    """First-person camera: height above the ball's centre, and field of view in degrees."""
    sky: Sky = "stars"
    """Sky in first person."""
    turning_rate: float = 40.0
    """First person: turning rate in radians/s for an action of 1."""
    heading_damping: float = 2.48
    """Leaves 0.403 of the turning rate after each simulator step: an action of 1 turns 0.27 radians in 5 steps."""
    push: float | None = 0.1
    """First person: velocity change per decision for an action of 1; None: that of accelerating at 10 units/s^2."""
    limited_every_step: bool = False
    """Limit velocities to 5 before every simulator step, as PointMaze does, instead of once per decision."""
    goal_radius: float = 0.1
    goal_travel: float = 0.1
    """A goal is reached if the mass is within goal_radius and moved less than goal_travel in the last decision."""
    goal_decisions: int = 150
    """Decisions after which a new goal is sampled even if the goal was not reached; 0: never."""
    goal_margin: float = 0.1
    """Goals are uniform over positions where the mass is at least this far from walls."""
    goals_are_cells: bool = True
    """Move a goal to its cell's goal point, which the planner heads for."""
    noise: float = 0.0
    """Standard deviation of Gaussian noise on every action in the data."""
    zero_share: float = 0.1
    random_share: float = 0.1
    """Shares of actions in the data that are zero, and uniformly random."""


SOURCE = Style()
"""Top view, as in the paper's data."""
_FIRST_PERSON = replace(SOURCE, goal_radius=0.5, goal_travel=np.inf, goals_are_cells=False)
"""First person, as in the paper's data."""
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
"""Wider curtains, a distant camera, a black sky, and noise on every action."""


@dataclass(frozen=True)
class MazeSpec:
    """A maze."""

    name: str
    paper: str
    """The paper's maze that this one is, or is a variant of."""
    curtains: tuple[Curtain, ...] = ()
    style: Style = SOURCE

    @property
    def gym_id(self) -> str:
        return f"vd4rl_pomdp/Maze{self.name.title().replace('_', '')}-v0"

    @property
    def driver(self) -> str:
        """Behaviour policy of its data: "ppo" or "planner"."""
        return "ppo" if self.first_person else "planner"

    @property
    def first_person(self) -> bool:
        """Whether the view is first-person; a state then has a heading."""
        return self.paper == "first_person"

    @property
    def position(self) -> list[int]:
        return [0, 1]

    @property
    def velocity(self) -> list[int]:
        """Indices of the velocity in a state, which is qpos followed by qvel."""
        return [3, 4] if self.first_person else [2, 3]

    def hidden(self, states: np.ndarray) -> np.ndarray:
        """Whether a curtain covers the whole visible ball: (..., P) states -> (...,) bool."""
        reach, within, height = self.style.hidden_reach, self.style.hidden_within, self.style.camera_height
        # perspective: magnification of a curtain's lower and upper faces, projected to the ball's height
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
    """Look up a maze; UserError with the choices for an unknown name."""
    refuse_unknown("maze", name, MAZES)
    return MAZES[name]
