"""The mazes' simulator: gymnasium-robotics' PointMaze U maze with curtains, or with a heading and eyes.

Curtains are drawn and never collide; goals are never drawn.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from pathlib import Path

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.maze_sky import FACE, sky_texture
from vd4rl_pomdp.envs.mazes import Curtain, MazeSpec, Sky, Style
from vd4rl_pomdp.envs.opengl import gl_errors
from vd4rl_pomdp.envs.rendering import mujoco

try:
    with gl_errors(), contextlib.redirect_stderr(io.StringIO()):  # it announces changes that do not matter here
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
"""Radius of the mass that hits walls."""
TIMESTEP = 0.01
HEADING = 2
"""Entry of qpos and qvel that is the heading of a mass with eyes."""
_WALL_HEIGHT = 0.4
_AHEAD = [0.5, 0.5, -0.5, -0.5]
"""Orientation of a camera that looks along x with z up."""


def build_simulator(spec: MazeSpec) -> tuple[PointEnv, Maze]:
    """PointMaze's own simulator on the changed model, and the library's description of the maze."""
    maze, file = Maze.make_maze(str(POINT_XML), U_MAZE, 1.0, _WALL_HEIGHT)
    try:
        xml = _change(spec, mujoco.MjSpec.from_file(file)).to_xml()
    finally:
        os.unlink(file)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "maze.xml"
        path.write_text(xml, encoding="utf-8")
        point = PointEnv(xml_file=str(path))
    if spec.first_person:
        point.model.dof_damping[HEADING] = spec.style.heading_damping
        _paint_sky(point.model, spec.style.sky)
    return point, maze


def _change(spec: MazeSpec, model: mujoco.MjSpec) -> mujoco.MjSpec:
    """Remove the goal, move the walls to their height, add curtains and the camera."""
    model.delete(model.site("target"))
    model.visual.quality.shadowsize = 0  # nothing casts a shadow: the only light is at the camera
    for wall in model.geoms:
        if wall.type == mujoco.mjtGeom.mjGEOM_BOX:
            wall.pos[2] = sum(spec.style.walls) / 2
    for number, curtain in enumerate(spec.curtains):
        _hang(model, f"curtain_{number}", curtain, spec.style)
    if spec.first_person:
        _open_eyes(model, spec.style)
    else:
        model.worldbody.add_camera(name="view", pos=[0, 0, spec.style.camera_height], fovy=spec.style.camera_fovy)
    return model


def _hang(model: mujoco.MjSpec, name: str, curtain: Curtain, style: Style) -> None:
    """Add a curtain, which does not collide."""
    bottom, top = style.curtains
    model.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[*curtain.center, (bottom + top) / 2],
        size=[*curtain.half, (top - bottom) / 2],
        rgba=[*style.curtain_color, 1.0],
        contype=0,
        conaffinity=0,
        group=2,
    )


def _open_eyes(model: mujoco.MjSpec, style: Style) -> None:
    """For first_person a heading, a camera in the mass, no ball around it, and a sky whose texture is drawn later."""
    model.visual.map.znear = 0.001  # walls are as near as 0.1
    body = model.body("particle")
    body.add_joint(name="heading", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    body.add_camera(name="view", pos=[0, 0, style.eye_height], quat=_AHEAD, fovy=style.eye_fovy)
    model.delete(model.site("particle_site"))
    sky = model.texture("skybox")
    sky.mark = mujoco.mjtMark.mjMARK_NONE
    sky.width, sky.height = FACE, 6 * FACE


def _paint_sky(model: mujoco.MjModel, sky: Sky) -> None:
    """Write the sky's texture into a compiled model."""
    start = int(model.tex_adr[model.tex("skybox").id])
    texture = sky_texture(sky)
    model.tex_data[start : start + len(texture)] = texture
