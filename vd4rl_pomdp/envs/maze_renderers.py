"""Render the mazes as (3, 100, 100) uint8: with MuJoCo (`exact`), or much faster with our own ray casting (`fast`).

From the top, only the ball moves. MuJoCo renders the maze's colours and depths once, at four times the resolution. The
ball is ray-cast as a sphere with the same camera and MuJoCo's headlight shading, and drawn where it is nearer than the
stored depth. So a ball fully behind a curtain changes no pixel.

In first person, one ray per column finds the nearest wall. The headlight shines along the view direction, so each wall
face has a single shade and the floor only ambient light: five colours plus the sky. The sky is looked up by azimuth in
a panorama of MuJoCo's cube texture. Pixels are averages of 2x2 rays.
"""

from __future__ import annotations

import numpy as np

from vd4rl_pomdp.envs.mazes import BALL_RADIUS, FREE_CELLS, HALF_SIZE, PICTURE_SIZE, MazeSpec, Sky, Style
from vd4rl_pomdp.envs.opengl import close_at_exit, gl_errors, refuse_after_fork, undisturbed
from vd4rl_pomdp.envs.pixels import Render
from vd4rl_pomdp.envs.rendering import mujoco

_FINE = 4
"""Supersampling factor per axis."""
_BALL_COLOR = np.array([0.3, 0.6, 0.3])
_WALL_COLOR = np.array([0.7, 0.5, 0.3])
_FLOOR_LIGHT, _FLOOR_DARK, _SQUARE = np.array([0.2, 0.3, 0.4]), np.array([0.1, 0.2, 0.3]), 2.0
_GROUND = -0.1
_AMBIENT, _DIFFUSE, _SPECULAR, _SHININESS = 0.4, 0.8, 0.045, 64
"""MuJoCo's headlight with PointMaze's materials."""


class ExactRenderer:
    """MuJoCo's rendering from the camera `view`, supersampled for smooth edges."""

    def __init__(self, model: mujoco.MjModel) -> None:
        refuse_after_fork()
        self._model = model
        model.vis.quality.offsamples = 0
        side = model.vis.global_.offwidth = model.vis.global_.offheight = PICTURE_SIZE * _FINE
        with gl_errors(), undisturbed():
            self.renderer = mujoco.Renderer(model, side, side)
        close_at_exit(self.renderer)

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Image of the current state; after a step, MuJoCo's body positions are still those before it."""
        mujoco.mj_kinematics(self._model, data)  # not mj_forward, which would change the solver's warm start
        mujoco.mj_camlight(self._model, data)
        return average(self.fine_picture(data), _FINE)

    def fine_picture(self, data: mujoco.MjData) -> np.ndarray:
        """Colours (H, H, 3) uint8, H = 100 * 4, or depths (H, H) float32 if `renderer` renders these."""
        self.renderer.update_scene(data, camera="view")
        with undisturbed():
            return self.renderer.render().copy()

    def close(self) -> None:
        self.renderer.close()


def average(fine: np.ndarray, by: int) -> np.ndarray:
    """Downsample (H, W, 3) uint8 to (3, H / by, W / by) uint8 by rounded area averages; `by` is at most 16."""
    rows = np.stack([fine[i::by] for i in range(by)]).sum(0, dtype=np.uint16)
    sums = np.stack([rows[:, i::by] for i in range(by)]).sum(0, dtype=np.uint16)
    return np.ascontiguousarray(((sums + by * by // 2) // (by * by)).astype(np.uint8).transpose(2, 0, 1))


class TopRenderer:
    """Fast renderer of the view from the top."""

    def __init__(self, model: mujoco.MjModel, style: Style) -> None:
        ball, exact, data = model.site("particle_site"), ExactRenderer(model), mujoco.MjData(model)
        color, ball.rgba[3] = ball.rgba.copy(), 0
        mujoco.mj_forward(model, data)
        self._colors = exact.fine_picture(data)
        """(H, H, 3) uint8, of the maze without the ball."""
        exact.renderer.enable_depth_rendering()
        self._depths = exact.fine_picture(data)
        exact.close()
        ball.rgba[:] = color
        self._picture = average(self._colors, _FINE)
        self._height = style.camera_height
        side, half = PICTURE_SIZE * _FINE, np.tan(np.radians(style.camera_fovy) / 2)
        self._slope = ((np.arange(side) + 0.5) / side * 2 - 1) * half
        """(side,) slope of each column's rays: sideways distance per unit of depth."""
        across = 2 * 1.05 * BALL_RADIUS / self._height / half * side / 2
        self._window = int(np.ceil(across / _FINE) + 2) * _FINE
        """Side, in rays, of the square in which the ball is drawn: a multiple of _FINE that fits the whole ball."""

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Image (3, 100, 100) uint8 of the current state."""
        picture = self._picture.copy()
        x, y = float(data.qpos[0]), float(data.qpos[1])
        left, top = self._corner(x), self._corner(-y)
        cells = slice(top, top + self._window), slice(left, left + self._window)
        right, down = self._slope[cells[1]][None, :], self._slope[cells[0]][:, None]
        depth, facing = _hit_sphere(right, -down, x, y, self._height)
        drawn = depth < self._depths[cells]
        if not drawn.any():
            return picture
        shade = np.where(facing > 0, _AMBIENT + _DIFFUSE * facing, 0)[..., None]
        colors = _BALL_COLOR * shade + (_SPECULAR * facing**_SHININESS)[..., None]
        patch = self._colors[cells].copy()
        patch[drawn] = np.minimum(colors[drawn] * 255 + 0.5, 255).astype(np.uint8)
        size = self._window // _FINE
        row, column = top // _FINE, left // _FINE
        picture[:, row : row + size, column : column + size] = average(patch, _FINE)
        return picture

    def _corner(self, sideways: float) -> int:
        """First ray of the window around a coordinate, a multiple of _FINE."""
        center = np.searchsorted(self._slope, sideways / self._height)
        first = (int(center) - self._window // 2) // _FINE * _FINE
        return min(max(first, 0), PICTURE_SIZE * _FINE - self._window)


def _hit_sphere(right: np.ndarray, up: np.ndarray, x: float, y: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays (right, up, -1) from the camera at (0, 0, height) with the ball at (x, y, 0).

    Returns:
        Depths (inf where a ray misses), and cosines between surface normal and direction to the camera.
    """
    squared = right**2 + up**2 + 1
    along = right * x + up * y + height
    inside = along**2 - squared * (x**2 + y**2 + height**2 - BALL_RADIUS**2)
    depth = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / squared, np.inf)
    return depth, np.sqrt(np.maximum(inside, 0) / squared) / BALL_RADIUS


class FirstPersonRenderer:
    """Fast renderer of the first-person view, without the faint specular highlight on walls seen head-on."""

    _FINE = 2
    _SKY, _LIGHT, _DARK, _SHADED, _WALL_X, _WALL_Y = range(6)
    _OFFSET = 64
    """Even number of floor squares added to coordinates, so that they are positive."""

    def __init__(self, style: Style) -> None:
        side = PICTURE_SIZE * self._FINE
        steps = ((np.arange(side) + 0.5) / side * 2 - 1) * np.tan(np.radians(style.eye_fovy) / 2)
        self._left, self._up = -steps, -steps[:, None]
        """(side,) and (side, 1) slopes of the rays, by column and by row."""
        self._eye, self._wall_top = style.eye_height, style.walls[1]
        self._wall_bottom = max(style.walls[0], _GROUND)
        # the sky is looked up in a panorama, for the rays of the image's upper half
        elevation = np.arctan2(self._up[: side // 2], np.hypot(1, self._left))
        levels = np.arange(0, elevation.max() + _BIN, _BIN)
        self._panorama = None if style.sky == "none" else panorama(sky_texture(style.sky), levels)
        self._level = (elevation / _BIN + 0.5).astype(np.int32)
        """(rows, columns) index into the panorama's elevation axis."""
        self._azimuth = np.arctan(self._left)
        self._to_floor = (self._eye - _GROUND) / steps[side // 2 :, None]
        """(side / 2, 1) distance ahead at which the lower half's rays hit the floor."""
        cells = [(row, column) for row in range(5) for column in range(5) if (row, column) not in FREE_CELLS]
        self._walls = np.array([(c + 0.5 - HALF_SIZE, HALF_SIZE - r - 0.5) for r, c in cells])[:, None]
        """(walls, 1, 2) centres of the wall cells."""

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Image (3, 100, 100) uint8 of the current state."""
        place, heading = data.qpos[:2], float(data.qpos[2])
        ahead = np.array([np.cos(heading), np.sin(heading)])
        rays = ahead + self._left[:, None] * np.array([-ahead[1], ahead[0]])
        distance, axis = self._nearest_wall(place, rays)
        lit = rays[np.arange(len(rays)), axis] * ahead[axis] > 0
        faces = np.where(lit, self._WALL_X + axis, self._SHADED).astype(np.uint8)
        height = self._eye + self._up * distance
        kinds = np.where(height <= self._wall_top, faces, np.uint8(self._SKY))
        lower = len(kinds) // 2
        x, y = (
            (self._to_floor * (rays[:, i] / _SQUARE) + (place[i] / _SQUARE + self._OFFSET)).astype(np.int32)
            for i in (0, 1)
        )
        floor = np.where((x ^ y) & 1, np.uint8(self._LIGHT), np.uint8(self._DARK))
        np.copyto(kinds[lower:], floor, where=height[lower:] < self._wall_bottom)
        walls = [_WALL_COLOR * (_AMBIENT + _DIFFUSE * light) for light in (0.0, *np.abs(ahead))]
        colors = np.array([np.zeros(3), _FLOOR_LIGHT * _AMBIENT, _FLOOR_DARK * _AMBIENT, *walls])
        palette = (np.minimum(colors, 1) * 255 + 0.5).astype(np.uint16)
        parts = [kinds[i :: self._FINE, j :: self._FINE] for i in range(self._FINE) for j in range(self._FINE)]
        sums = [sum(shade[part] for part in parts) for shade in palette.T]
        picture = ((np.stack(sums) + self._FINE) // self._FINE**2).astype(np.uint8)
        sky = kinds[:lower] == self._SKY
        if self._panorama is not None and sky.any():
            column = ((heading + self._azimuth + np.pi) / _BIN).astype(np.int32) % BINS
            picture[:, : PICTURE_SIZE // 2] += average(self._panorama[column, self._level] * sky[..., None], self._FINE)
        return picture

    def _nearest_wall(self, place: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance ahead (columns,) of the nearest wall on each ray (columns, 2), and the axis of the face hit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = ((self._walls + half - place) / rays for half in (-0.5, 0.5))
        enter, leave = np.minimum(one, other), np.maximum(one, other)
        first, last = np.maximum(*np.moveaxis(enter, -1, 0)), np.minimum(*np.moveaxis(leave, -1, 0))
        hit = np.where((first < last) & (first > 0), first, np.inf)
        wall, columns = hit.argmin(0), np.arange(len(rays))
        return hit[wall, columns], enter[wall, columns].argmax(-1)


FACE = 400
"""Texels per edge of the skybox cube."""
BINS = 2048
"""Columns of a panorama: azimuths from -pi, counterclockwise."""
_BIN = 2 * np.pi / BINS
_TOP, _STARS, _TWINKLE = np.array([0.4, 0.6, 0.8]), 0.01, 2
"""PointMaze's sky: colour at the zenith (black at the nadir), share of white texels, star texels per texel edge."""
_ACROSS = (np.arange(FACE) + 0.5) / FACE * 2 - 1
_ROW, _COLUMN = (axis.ravel() for axis in np.meshgrid(_ACROSS, _ACROSS, indexing="ij"))
_ONE = np.ones(FACE * FACE)
_FACES = (
    (_ONE, _COLUMN, -_ROW),
    (-_ONE, -_COLUMN, -_ROW),
    (_COLUMN, -_ROW, _ONE),
    (_COLUMN, _ROW, -_ONE),
    (_COLUMN, -_ONE, -_ROW),
    (-_COLUMN, _ONE, -_ROW),
)
"""Directions (x, y, z) of each cube face's texels, in MuJoCo's order."""


def sky_texture(sky: Sky) -> np.ndarray:
    """Skybox texture, (6 * FACE * FACE * 3,) uint8 as in MuJoCo's `tex_data`."""
    if sky == "none":
        return np.zeros(6 * FACE * FACE * 3, np.uint8)
    x, y, z = np.concatenate([np.stack(face) for face in _FACES], 1)
    if sky == "compass":  # one turn of the colour wheel around the horizon; luminance has one maximum, too
        colors = 0.5 + 0.5 * np.cos(np.arctan2(y, x)[:, None] - np.array([0, 2, 4]) * np.pi / 3)
    else:
        share = np.arctan2(z, np.hypot(x, y)) / (np.pi / 2)
        colors = (1 + share / np.sqrt(1 + share**2) * np.sqrt(2))[:, None] / 2 * _TOP  # MuJoCo's builtin gradient
        side = FACE * _TWINKLE
        stars = np.random.default_rng(0).random((6, side, side), np.float32) < _STARS  # fixed seed: same stars always
        light = stars.reshape(6, FACE, _TWINKLE, FACE, _TWINKLE).mean((2, 4)).ravel()
        colors = colors + light[:, None] * (1 - colors)
    return (colors * 255 + 0.5).astype(np.uint8).ravel()


def panorama(texture: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Colours (BINS, E, 3) uint8 of a `sky_texture`, by azimuth and elevation (E,) in radians."""
    azimuth = (np.arange(BINS)[:, None] + 0.5) / BINS * 2 * np.pi - np.pi
    level = np.cos(elevations)
    x, y, z = np.broadcast_arrays(np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevations))
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    found = np.zeros((*x.shape, 3), np.uint8)
    x, y, z = (side / largest for side in (x, y, z))
    places = ((x == 1, y, -z), (x == -1, -y, -z), (z == 1, x, -y), (z == -1, x, y), (y == -1, x, -z), (y == 1, -x, -z))
    for face, (mask, column, row) in zip(texture.reshape(6, FACE, FACE, 3), places, strict=True):
        at = [np.minimum(((side[mask] + 1) / 2 * FACE).astype(int), FACE - 1) for side in (row, column)]
        found[mask] = face[at[0], at[1]]
    return found


MazeRenderer = ExactRenderer | TopRenderer | FirstPersonRenderer


def make_renderer(spec: MazeSpec, model: mujoco.MjModel, render: Render) -> MazeRenderer:
    """Renderer of a maze: MuJoCo with supersampling for `exact`, ray casting for `fast`."""
    if render == "exact":
        return ExactRenderer(model)
    return FirstPersonRenderer(spec.style) if spec.first_person else TopRenderer(model, spec.style)
