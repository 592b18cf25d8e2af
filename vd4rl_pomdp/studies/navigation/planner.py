"""The planners that collect top-view data: a shortest path over the cells, a PD controller towards its next one."""

from __future__ import annotations

from collections import deque

import numpy as np

from vd4rl_pomdp.envs.maze import CELL_OFFSET, MazeEnv

POSITION_GAIN, VELOCITY_GAIN = 3.0, 0.6
"""Action for each unit of distance to the waypoint, and against each unit/s of velocity."""
Cell = tuple[int, int]
"""Row and column of a square of the maze's grid."""


class Planner:
    """Drives the mass to the environment's goal, straight through the cells; noise is the caller's."""

    def __init__(self, env: MazeEnv) -> None:
        self._env = env
        self._maze = env.maze
        self._next = {cell: self._towards(cell) for cell in self._free_cells()}
        """By goal cell: the next cell on the shortest path from every cell."""

    def act(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Action (2,) float64 for a (4,) state and a (2,) goal."""
        return POSITION_GAIN * (self.waypoint(state[:2], goal) - state[:2]) - VELOCITY_GAIN * state[2:]

    def waypoint(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The point to head for from a (2,) position: the goal if it is at most one cell away, else the next cell."""
        following, there = self._next[self._cell(goal)][self._cell(position)], self._cell(goal)
        return goal if following == there else self._maze.cell_rowcol_to_xy(np.array(following))

    def distance(self, position: np.ndarray, goal: np.ndarray) -> float:
        """Length of the path over the waypoints from a (2,) position to a goal."""
        length, here = 0.0, position
        while True:
            target = self.waypoint(here, goal)
            length += float(np.linalg.norm(target - here))
            if target is goal:
                return length
            here = target

    def cells_after(self, position: np.ndarray, goal: np.ndarray) -> list[np.ndarray]:
        """Centres (2,) of the cells on the shortest path from a position to a goal, without the first one."""
        here, there, centers = self._cell(position), self._cell(goal), []
        while here != there:
            here = self._next[there][here]
            centers.append(self._maze.cell_rowcol_to_xy(np.array(here)))
        return centers

    def _cell(self, position: np.ndarray) -> Cell:
        row, column = self._maze.cell_xy_to_rowcol(position)
        return int(row), int(column)

    def _free_cells(self) -> list[Cell]:
        rows = enumerate(self._maze.maze_map)
        return [(i, j) for i, row in rows for j, kind in enumerate(row) if kind != 1]

    def _towards(self, goal: Cell) -> dict[Cell, Cell]:
        """Breadth-first search from a goal: the next cell to enter from every cell; the goal leads to itself."""
        free, following, queue = set(self._free_cells()), {goal: goal}, deque([goal])
        while queue:
            i, j = queue.popleft()
            for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if cell in free and cell not in following:
                    following[cell] = (i, j)
                    queue.append(cell)
        return following


class WaypointPlanner:
    """The planner of the published generator: it halts at a waypoint beside every cell's centre, and then at the goal.

    A waypoint is passed at walking pace: within NEAR of it by a mass that moved less than NEAR in the last decision.
    """

    NEAR = 0.1
    POSITION_GAIN, VELOCITY_GAIN = 5.0, 1.0
    JITTER = 0.2
    """Waypoints but the last lie up to this much, uniformly, from their cells' points back towards the centres."""

    def __init__(self, env: MazeEnv, rng: np.random.Generator) -> None:
        self._planner, self._rng = Planner(env), rng
        self._goal, self._before = np.full(2, np.nan), np.zeros(2)
        self._ahead: list[np.ndarray] = []

    def act(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Action (2,) float64 for a (4,) state and a (2,) goal."""
        place = state[:2]
        if not np.array_equal(goal, self._goal):
            self._plan(place, goal)
        action = self.POSITION_GAIN * (self._ahead[0] - place) - self.VELOCITY_GAIN * state[2:]
        slow = np.linalg.norm(place - self._before) < self.NEAR
        if len(self._ahead) > 1 and slow and np.linalg.norm(place - self._ahead[0]) < self.NEAR:
            self._ahead.pop(0)
        self._before = place
        return action

    def _plan(self, place: np.ndarray, goal: np.ndarray) -> None:
        """Waypoints to a goal, from a (2,) place."""
        between = self._planner.cells_after(place, goal)[:-1]
        back = self._rng.uniform(size=(len(between), 2)) * self.JITTER * np.sign(CELL_OFFSET)
        self._ahead = [*(np.array(between).reshape(-1, 2) + CELL_OFFSET - back), goal]
        self._goal, self._before = goal, place
