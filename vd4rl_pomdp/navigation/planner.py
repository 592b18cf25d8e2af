"""The planner that collects top-view data: a shortest path over the cells, a PD controller towards its next one."""

from __future__ import annotations

from collections import deque

import numpy as np

from vd4rl_pomdp.envs.maze import MazeEnv

POSITION_GAIN, VELOCITY_GAIN = 3.0, 0.6
"""Action for each unit of distance to the waypoint, and against each unit/s of velocity."""
Cell = tuple[int, int]
"""Row and column of a square of the maze's grid."""


class Planner:
    """Drives the mass to the environment's goal; Gaussian noise is the caller's."""

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
