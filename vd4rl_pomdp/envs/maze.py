"""The mazes as Gymnasium environments with pixel observations, acceleration actions, and goals that are resampled.

The simulator is gymnasium-robotics' PointMaze U maze, with curtains or with a first-person camera. Curtains are visible
but do not collide; goals are invisible.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from vd4rl_pomdp.core.errors import UserError, refuse_number
from vd4rl_pomdp.envs import Info
from vd4rl_pomdp.envs.maze_renderers import FACE, ExactRenderer, MazeRenderer, make_renderer, sky_texture
from vd4rl_pomdp.envs.mazes import ACTION_REPEAT, MOST_STEPS, PICTURE_SIZE, MazeSpec, get_maze
from vd4rl_pomdp.envs.opengl import gl_errors
from vd4rl_pomdp.envs.pixels import Render, check_render, checked_action
from vd4rl_pomdp.envs.rendering import mujoco

try:
    with gl_errors(), contextlib.redirect_stderr(io.StringIO()):  # hide its import-time notices
        import gymnasium_robotics
        from gymnasium_robotics.envs.maze.maps import U_MAZE
        from gymnasium_robotics.envs.maze.maze_v4 import Maze
        from gymnasium_robotics.envs.maze.point import PointEnv
except ImportError as error:
    raise UserError(
        f"the mazes need gymnasium-robotics ({error}): `pip install '.[navigation]'` in the package's folder"
    ) from error

POINT_XML = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "point" / "point.xml"
COLLISION_RADIUS = 0.1
"""Collision radius of the point mass."""
TIMESTEP = 0.01
HEADING = 2
"""Index of the heading in qpos and qvel, in first person."""
_WALL_HEIGHT = 0.4
_AHEAD = [0.5, 0.5, -0.5, -0.5]
"""Quaternion of a camera that looks along x with z up."""
ACCELERATION = 10.0
"""First person without a `push`: acceleration along the heading, in units/s^2, for an action of 1 (from the top: 23.9).
The velocity change of a whole decision is applied at its start."""
FASTEST = 5.0
"""Velocity limit per axis, as in PointMaze."""
CELL_OFFSET = np.array([0.2, -0.2])
"""Offset from a cell's centre to its goal point; the original generator's grid is offset from its walls."""


class MazeEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point mass in a U-shaped maze, seen from the top (with or without curtains) or in first person.

    Observations: (3, 100, 100) uint8. Actions: (2,) float32 in [-1, 1]: accelerations in x and y or, in first person,
    acceleration along the heading and turning rate. The reward is 1 whenever a goal is reached; the environment never
    terminates. `info` holds `state` (x, y, vx, vy; in first person x, y, heading, vx, vy, angular velocity), `goal`
    (2,) and `hidden`, whether a curtain covers the ball. A maze's parameters are in its `style`. `reset(seed=...)`
    determines all following starts and goals.
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
        """gymnasium-robotics' description of the cells."""
        self._pixels, self._render = pixels, render
        self._renderer: MazeRenderer | None = None
        self.observation_space = gymnasium.spaces.Box(0, 255, (3, PICTURE_SIZE, PICTURE_SIZE), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / (TIMESTEP * action_repeat))}
        self._picture = np.zeros((3, PICTURE_SIZE, PICTURE_SIZE), np.uint8)
        self.goal = np.zeros(2)
        """(2,) position of the goal."""
        self._decisions = 0
        """Decisions since the goal was sampled."""

    @property
    def state(self) -> np.ndarray:
        """(P,) float64: qpos, then qvel."""
        return np.concatenate([self._point.data.qpos, self._point.data.qvel])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Sample a start at rest and a goal; `options={"state": (P,)}` sets the state instead."""
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
        """Repeat an action; UserError if it has another shape or NaN."""
        before, style = self.state[:2], self.maze_spec.style
        self._simulate(np.clip(np.asarray(checked_action(action, 2), np.float64), -1, 1))
        place = self.state[:2]
        near = np.linalg.norm(place - self.goal) <= style.goal_radius
        # passing through is not enough: where `goal_travel` is finite, the mass must also have slowed down
        reached = bool(near and np.linalg.norm(place - before) < style.goal_travel)
        self._decisions += 1
        if reached or self._decisions == style.goal_decisions:
            self._draw_goal()
        observation, info = self._observation_and_info()
        return observation, float(reached), False, False, info

    def set_state(self, state: np.ndarray) -> None:
        """Set the simulator to a (P,) state; UserError if it has another shape or is not finite."""
        count, size = self._point.model.nq, self._point.model.nq + self._point.model.nv
        state = np.asarray(state, np.float64)
        if state.shape != (size,) or not np.isfinite(state).all():
            raise UserError(f"{self.maze_spec.name}: a state is {size} finite numbers, not {state.tolist()}")
        self._point.set_state(state[:count], state[count:])

    def render(self) -> np.ndarray:
        """The newest image: (100, 100, 3) uint8."""
        return np.ascontiguousarray(self._picture.transpose(1, 2, 0))

    def close(self) -> None:
        if isinstance(self._renderer, ExactRenderer):
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_renderer": None}  # an OpenGL context cannot be copied; the copy makes its own

    def is_free(self, place: np.ndarray, room: float = 0.0) -> bool:
        """Whether the mass, enlarged by `room`, fits at position `place` (2,) without touching a wall."""
        corners = place + (COLLISION_RADIUS + room) * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        cells = [self.maze.cell_xy_to_rowcol(corner) for corner in corners]
        return all(self.maze.maze_map[row][column] != 1 for row, column in cells)

    def goal_point(self, place: np.ndarray) -> np.ndarray:
        """Goal (2,) for a free position: its cell's goal point if `goals_are_cells`, else the position itself."""
        if not self.maze_spec.style.goals_are_cells:
            return place
        return np.round(place - CELL_OFFSET) + CELL_OFFSET

    def _draw_goal(self) -> None:
        self.goal, self._decisions = self.goal_point(self._free_place(self.maze_spec.style.goal_margin)), 0

    def _simulate(self, action: np.ndarray) -> None:
        """Run PointMaze's simulator steps; in first person the action sets velocities first, and the motors get 0."""
        style, point = self.maze_spec.style, self._point
        if self.maze_spec.first_person:
            if style.push is None or action.any():  # with a push, the original generator changes no velocities for 0
                push = ACCELERATION * TIMESTEP * self._repeat if style.push is None else style.push
                qpos, qvel = point.data.qpos.copy(), point.data.qvel.copy()
                qvel[:2] += action[0] * push * np.array([np.cos(qpos[HEADING]), np.sin(qpos[HEADING])])
                qvel[HEADING] = action[1] * style.turning_rate
                point.set_state(qpos, qvel)
            action = np.zeros(2)
        if style.limited_every_step:
            for _ in range(self._repeat):
                point.step(action)
            return
        qvel = point.data.qvel.copy()
        qvel[:2] = np.clip(qvel[:2], -FASTEST, FASTEST)
        point.set_state(point.data.qpos.copy(), qvel)
        point.do_simulation(action, self._repeat)

    def _free_place(self, room: float = 0.0) -> np.ndarray:
        """Position sampled uniformly from where the mass, enlarged by `room`, fits."""
        while True:
            place = self.np_random.uniform(-1.5, 1.5, 2)
            if self.is_free(place, room):
                return place

    def draw(self) -> np.ndarray:
        """Image of the current state: (3, 100, 100) uint8."""
        assert self._pixels, "this environment was made without pixels"
        if self._renderer is None:  # created late, because a process that has rendered cannot be forked
            self._renderer = make_renderer(self.maze_spec, self._point.model, self._render)
        return self._renderer(self._point.data)

    def _observation_and_info(self) -> tuple[np.ndarray, Info]:
        if self._pixels:
            self._picture = self.draw()
        state = self.state
        info = {"state": state, "goal": self.goal.copy(), "hidden": bool(self.maze_spec.hidden(state))}
        return self._picture.copy(), info


def replay_states(maze: str, state: np.ndarray, actions: np.ndarray, action_repeat: int = ACTION_REPEAT) -> np.ndarray:
    """Replay (T, 2) actions from a (P,) state: states (T, P) float64 after each action."""
    env = MazeEnv(maze, action_repeat, pixels=False)
    env.reset(options={"state": state})
    return np.array([env.step(action)[-1]["state"] for action in actions]).reshape(-1, len(state))


def build_simulator(spec: MazeSpec) -> tuple[PointEnv, Maze]:
    """PointMaze's simulator with the maze's modified model, and gymnasium-robotics' description of the maze."""
    maze, file = Maze.make_maze(str(POINT_XML), U_MAZE, 1.0, _WALL_HEIGHT)
    path = Path(file)
    try:
        path.write_text(_change(spec, mujoco.MjSpec.from_file(file)).to_xml(), encoding="utf-8")
        point = PointEnv(xml_file=file)
    finally:
        path.unlink()
    if spec.first_person:
        point.model.dof_damping[HEADING] = spec.style.heading_damping
        start, texture = int(point.model.tex_adr[point.model.tex("skybox").id]), sky_texture(spec.style.sky)
        point.model.tex_data[start : start + len(texture)] = texture
    return point, maze


def _change(spec: MazeSpec, model: mujoco.MjSpec) -> mujoco.MjSpec:
    """Remove the goal marker, set the walls' height, add curtains and the camera."""
    model.delete(model.site("target"))
    model.visual.quality.shadowsize = 0  # no visible shadows: the only light is at the camera
    for wall in model.geoms:
        if wall.type == mujoco.mjtGeom.mjGEOM_BOX:
            wall.pos[2] = sum(spec.style.walls) / 2
    bottom, top = spec.style.curtains
    for number, curtain in enumerate(spec.curtains):
        model.worldbody.add_geom(
            name=f"curtain_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*curtain.center, (bottom + top) / 2],
            size=[*curtain.half, (top - bottom) / 2],
            rgba=[*spec.style.curtain_color, 1.0],
            contype=0,  # no collisions: a curtain only hides
            conaffinity=0,
            group=2,
        )
    if not spec.first_person:
        model.worldbody.add_camera(name="view", pos=[0, 0, spec.style.camera_height], fovy=spec.style.camera_fovy)
        return model
    # a heading joint, a camera in the mass, no visible ball, and a skybox to be filled later
    model.visual.map.znear = 0.001  # walls come as near as 0.1
    body = model.body("particle")
    body.add_joint(name="heading", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    body.add_camera(name="view", pos=[0, 0, spec.style.eye_height], quat=_AHEAD, fovy=spec.style.eye_fovy)
    model.delete(model.site("particle_site"))
    sky = model.texture("skybox")
    sky.mark = mujoco.mjtMark.mjMARK_NONE
    sky.width, sky.height = FACE, 6 * FACE
    return model
