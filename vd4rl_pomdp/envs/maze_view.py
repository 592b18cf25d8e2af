"""Pictures of the mazes, (3, 100, 100) uint8: MuJoCo's own, and the same much faster.

Seen from the top only the ball moves. So MuJoCo draws the maze and its depth once, four times finer than the picture;
the ball is then a sphere cut by 40x40 rays of the same camera, shaded like MuJoCo's headlight shades, and put where it
is nearer than what MuJoCo drew. A ball that is wholly behind a curtain therefore changes no pixel.

In first person everything moves, and MuJoCo draws it all, without the finer rays when it should be fast.
"""

from __future__ import annotations

import numpy as np

from vd4rl_pomdp.envs.maze_model import CAMERA_HEIGHT, TOP_FOVY
from vd4rl_pomdp.envs.rendering import Render, gl_error, mujoco
from vd4rl_pomdp.mazes import BALL_RADIUS, PICTURE_SIZE, MazeSpec

_FINE = 4
"""Rays for each pixel, in each direction."""
_BALL_COLOR = np.array([0.3, 0.6, 0.3])
_AMBIENT, _DIFFUSE, _SPECULAR, _SHININESS = 0.4, 0.8, 0.045, 64
"""MuJoCo's headlight on PointMaze's materials."""


class ExactView:
    """MuJoCo's picture from the camera `view`, drawn finer and averaged, so that edges are smooth."""

    def __init__(self, model: mujoco.MjModel, fine: int = _FINE) -> None:
        self._fine = fine
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = PICTURE_SIZE * fine
        try:
            self._renderer = mujoco.Renderer(model, PICTURE_SIZE * fine, PICTURE_SIZE * fine)
        except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
            raise gl_error(error) from error
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Picture of a state that `mj_forward` has seen."""
        self._renderer.update_scene(data, camera="view")
        return average(self._renderer.render(), self._fine)

    def fine_picture(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Colours (H, H, 3) uint8 and depths (H, H) float32 before averaging, H = 100 * fine."""
        self._renderer.update_scene(data, camera="view")
        colors = self._renderer.render().copy()
        self._renderer.enable_depth_rendering()
        depths = self._renderer.render().copy()
        self._renderer.disable_depth_rendering()
        return colors, depths

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


def average(fine: np.ndarray, by: int) -> np.ndarray:
    """(H, W, 3) uint8 -> (3, H / by, W / by) uint8, rounded area averages."""
    height, width = fine.shape[0] // by, fine.shape[1] // by
    sums = fine.reshape(height, by, width, by, 3).sum((1, 3), dtype=np.uint32)
    return np.ascontiguousarray(((sums + by * by // 2) // (by * by)).astype(np.uint8).transpose(2, 0, 1))


class TopView:
    """The fast picture from the top."""

    _WINDOW = 48
    """Rays across the square in which the ball is drawn: a multiple of _FINE with room for the whole ball."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._colors, self._depths = _static_picture(model)
        self._picture = average(self._colors, _FINE)
        side = PICTURE_SIZE * _FINE
        self._slope = ((np.arange(side) + 0.5) / side * 2 - 1) * np.tan(np.radians(TOP_FOVY) / 2)
        """(side,) sideways travel of a ray for each unit of depth, by column."""

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Picture of a state."""
        picture = self._picture.copy()
        x, y = float(data.qpos[0]), float(data.qpos[1])
        left, top = self._corner(x), self._corner(-y)
        cells = slice(top, top + self._WINDOW), slice(left, left + self._WINDOW)
        right, down = self._slope[cells[1]][None, :], self._slope[cells[0]][:, None]
        depth, facing = _hit_sphere(right, -down, x, y)
        drawn = depth < self._depths[cells]
        if not drawn.any():
            return picture
        shade = np.where(facing > 0, _AMBIENT + _DIFFUSE * facing, 0)[..., None]
        colors = _BALL_COLOR * shade + (_SPECULAR * facing**_SHININESS)[..., None]
        patch = self._colors[cells].copy()
        patch[drawn] = np.minimum(colors[drawn] * 255 + 0.5, 255).astype(np.uint8)
        size = self._WINDOW // _FINE
        row, column = top // _FINE, left // _FINE
        picture[:, row : row + size, column : column + size] = average(patch, _FINE)
        return picture

    def _corner(self, sideways: float) -> int:
        """First ray, a multiple of _FINE, of a window around a coordinate."""
        center = np.searchsorted(self._slope, sideways / CAMERA_HEIGHT)
        first = (int(center) - self._WINDOW // 2) // _FINE * _FINE
        return min(max(first, 0), PICTURE_SIZE * _FINE - self._WINDOW)


def _static_picture(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depths of the maze without the ball."""
    color = model.site("particle_site").rgba.copy()
    model.site("particle_site").rgba[3] = 0
    view = ExactView(model)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    picture = view.fine_picture(data)
    view.close()
    model.site("particle_site").rgba[:] = color
    return picture


def _hit_sphere(right: np.ndarray, up: np.ndarray, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (right, up, -1) from the camera first meet the ball at (x, y, 0).

    Returns:
        Depths (inf where a ray misses), and cosines between the ball's surface and the direction to the camera.
    """
    squared = right**2 + up**2 + 1
    along = right * x + up * y + CAMERA_HEIGHT
    inside = along**2 - squared * (x**2 + y**2 + CAMERA_HEIGHT**2 - BALL_RADIUS**2)
    depth = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / squared, np.inf)
    return depth, np.sqrt(np.maximum(inside, 0) / squared) / BALL_RADIUS


View = ExactView | TopView


def make_view(spec: MazeSpec, model: mujoco.MjModel, render: Render) -> View:
    """What draws a maze: `exact` is MuJoCo alone with smooth edges, `fast` as the module says."""
    if spec.first_person:
        return ExactView(model, _FINE if render == "exact" else 1)
    return TopView(model) if render == "fast" else ExactView(model)
