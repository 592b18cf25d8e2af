"""The mazes as Gymnasium environments: pixels in, accelerations out, goals that move when they are reached."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.errors import refuse_number
from vd4rl_pomdp.envs import Info
from vd4rl_pomdp.envs.maze_model import COLLISION_RADIUS, HEADING, TIMESTEP, build_simulator
from vd4rl_pomdp.envs.maze_renderers import ExactRenderer, MazeRenderer, make_renderer
from vd4rl_pomdp.envs.mazes import ACTION_REPEAT, MOST_STEPS, PICTURE_SIZE, get_maze
from vd4rl_pomdp.envs.pixels import Render, check_render, checked_action
from vd4rl_pomdp.envs.rendering import mujoco

ACCELERATION = 10.0
"""first_person without a `push`: units/s^2 along the heading for an action of 1 (from the top it is 23.9);
what they come to in a decision is added at its beginning."""
FASTEST = 5.0
"""Velocities are limited to this on each axis, as in PointMaze."""
CELL_OFFSET = np.array([0.2, -0.2])
"""From a cell's centre to the point that stands for it as a goal: the generator's grid lies beside its walls."""


class MazeEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point mass in a U-shaped maze, seen from the top (with curtains or not) or in first person.

    Observations: (3, 100, 100) uint8. Actions: (2,) float32 in [-1, 1]: accelerations in x and y, or along the heading
    and the turning rate. The reward is 1 whenever a goal is reached; nothing terminates. `info` holds `state` (qpos,
    then qvel: x, y, vx, vy; in first person x, y, heading, vx, vy, angular velocity), `goal` (2,) and `hidden`,
    whether a curtain covers the whole mass. What differs between mazes is in their `style`. A seed fixes all starts
    and goals that follow it.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's own name and type)

    def __init__(
        self,
        maze: str,
        action_repeat: int = ACTION_REPEAT,
        render: Render = "fast",
        pixels: bool = True,
        render_mode: str | None = None,
    ) -> None:
        check_render(render)
        refuse_number("action_repeat", action_repeat, 1, MOST_STEPS)
        self.maze_spec = get_maze(maze)
        self._repeat = action_repeat
        self._point, self.maze = build_simulator(self.maze_spec)
        """The library's description of the cells."""
        self._pixels, self._render = pixels, render
        self._renderer: MazeRenderer | None = None
        self.observation_space = gymnasium.spaces.Box(0, 255, (3, PICTURE_SIZE, PICTURE_SIZE), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / (TIMESTEP * action_repeat))}
        self._picture = np.zeros((3, PICTURE_SIZE, PICTURE_SIZE), np.uint8)
        self.goal = np.zeros(2)
        """(2,) position to go to."""
        self._decisions = 0
        """Since the goal was drawn."""

    @property
    def state(self) -> np.ndarray:
        """(P,) float64: qpos, then qvel."""
        return np.concatenate([self._point.data.qpos, self._point.data.qvel])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Put the mass somewhere, at rest, and draw a goal; `options={"state": (P,)}` chooses the state."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self._point.model, self._point.data)
        qpos = np.zeros(self._point.model.nq)
        qpos[:2] = self._free_place()
        if self.maze_spec.first_person:
            qpos[2] = self.np_random.uniform(-np.pi, np.pi)
        state = np.concatenate([qpos, np.zeros(self._point.model.nv)])
        self.set_state((options or {}).get("state", state))
        self._draw_goal()
        return self._observation_and_info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Apply one action for the action repeat; UserError for one of another shape, or NaN."""
        before = self.state[:2]
        self._simulate(np.clip(np.asarray(checked_action(action, 2), np.float64), -1, 1))
        reached = self._at_goal(before)
        self._decisions += 1
        if reached or self._decisions == self.maze_spec.style.goal_decisions:
            self._draw_goal()
        observation, info = self._observation_and_info()
        return observation, float(reached), False, False, info

    def set_state(self, state: np.ndarray) -> None:
        """Put the simulator into a (P,) state."""
        count = self._point.model.nq
        self._point.set_state(np.asarray(state[:count], np.float64), np.asarray(state[count:], np.float64))

    def render(self) -> np.ndarray:
        """The newest picture: (100, 100, 3) uint8."""
        return np.ascontiguousarray(self._picture.transpose(1, 2, 0))

    def close(self) -> None:
        """Free the GL context, if there is one."""
        if isinstance(self._renderer, ExactRenderer):
            self._renderer.close()

    def is_free(self, place: np.ndarray, room: float = 0.0) -> bool:
        """Whether the mass fits at a (2,) position, with room around it."""
        corners = place + (COLLISION_RADIUS + room) * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        cells = [self.maze.cell_xy_to_rowcol(corner) for corner in corners]
        return all(self.maze.maze_map[row][column] != 1 for row, column in cells)

    def goal_point(self, place: np.ndarray) -> np.ndarray:
        """The goal (2,) that a free place stands for: the point of its cell, or itself."""
        if not self.maze_spec.style.goals_are_cells:
            return place
        return np.round(place - CELL_OFFSET) + CELL_OFFSET

    def _at_goal(self, before: np.ndarray) -> bool:
        """Whether the goal is reached by a mass that was at a (2,) position when the decision began."""
        place, style = self.state[:2], self.maze_spec.style
        near = np.linalg.norm(place - self.goal) <= style.goal_radius
        return bool(near and np.linalg.norm(place - before) < style.goal_travel)

    def _draw_goal(self) -> None:
        self.goal, self._decisions = self.goal_point(self._free_place(self.maze_spec.style.goal_margin)), 0

    def _simulate(self, action: np.ndarray) -> None:
        """PointMaze's own steps; in first person the velocities are changed first, and no motor runs."""
        if self.maze_spec.first_person:
            self._steer(action)
            action = np.zeros(2)
        if self.maze_spec.style.limited_every_step:
            for _ in range(self._repeat):
                self._point.step(action)
            return
        qvel = self._point.data.qvel.copy()
        qvel[:2] = np.clip(qvel[:2], -FASTEST, FASTEST)
        self._point.set_state(self._point.data.qpos.copy(), qvel)
        self._point.do_simulation(action, self._repeat)

    def _steer(self, action: np.ndarray) -> None:
        """Set the turning rate and push the mass along its heading."""
        style = self.maze_spec.style
        if style.push is not None and not action.any():
            return  # the generator leaves velocities alone
        push = ACCELERATION * TIMESTEP * self._repeat if style.push is None else style.push
        qpos, qvel = self._point.data.qpos.copy(), self._point.data.qvel.copy()
        qvel[:2] += action[0] * push * np.array([np.cos(qpos[HEADING]), np.sin(qpos[HEADING])])
        qvel[HEADING] = action[1] * style.turning_rate
        self._point.set_state(qpos, qvel)

    def _free_place(self, room: float = 0.0) -> np.ndarray:
        """A position drawn uniformly from where the mass fits, with room around it."""
        while True:
            place = self.np_random.uniform(-1.5, 1.5, 2)
            if self.is_free(place, room):
                return place

    def draw(self) -> np.ndarray:
        """Picture of the present state: (3, 100, 100) uint8."""
        assert self._pixels, "this environment was made without pixels"
        if self._renderer is None:  # not before: a process that has rendered cannot be forked
            self._renderer = make_renderer(self.maze_spec, self._point.model, self._render)
        return self._renderer(self._point.data)

    def _observation_and_info(self) -> tuple[np.ndarray, Info]:
        if self._pixels:
            self._picture = self.draw()
        state = self.state
        info = {"state": state, "goal": self.goal.copy(), "hidden": bool(self.maze_spec.hidden(state))}
        return self._picture, info


def replay_states(maze: str, state: np.ndarray, actions: np.ndarray, action_repeat: int = ACTION_REPEAT) -> np.ndarray:
    """True states (T, P) float64 after each of (T, 2) actions from a (P,) state."""
    env = MazeEnv(maze, action_repeat, pixels=False)
    env.reset(options={"state": state})
    return np.array([env.step(action)[-1]["state"] for action in actions]).reshape(-1, len(state))
