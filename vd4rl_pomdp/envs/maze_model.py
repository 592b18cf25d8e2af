"""The four mazes' simulator: gymnasium-robotics' PointMaze U maze with curtains, or with a heading and eyes.

Curtains are drawn and never collide; goals are never drawn.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from pathlib import Path

import numpy as np

from vd4rl_pomdp.envs.rendering import mujoco
from vd4rl_pomdp.mazes import MazeSpec

with contextlib.redirect_stderr(
    io.StringIO()
):  # gymnasium-robotics announces changes of environments that are not used here
    import gymnasium_robotics
    from gymnasium_robotics.envs.maze.maps import U_MAZE
    from gymnasium_robotics.envs.maze.maze_v4 import Maze
    from gymnasium_robotics.envs.maze.point import PointEnv

POINT_XML = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "point" / "point.xml"
WALL_HEIGHT = 0.4
COLLISION_RADIUS = 0.1
"""Radius of the mass that hits walls."""
TIMESTEP = 0.01
CAMERA_HEIGHT = 40.0
"""The camera is far above, so that a curtain hides almost the same region at every height."""
TOP_FOVY = float(np.degrees(2 * np.arctan(2.5 / (CAMERA_HEIGHT - WALL_HEIGHT))))
"""Field of view in which the walls' outer edges touch the image's border."""
EYE_HEIGHT, EYE_FOVY = 0.15, 75.0
_AHEAD = [0.5, 0.5, -0.5, -0.5]
"""Orientation of a camera that looks along x with z up."""


def build_simulator(spec: MazeSpec) -> tuple[PointEnv, Maze]:
    """PointMaze's own simulator on the changed model, and the library's description of the maze."""
    maze, file = Maze.make_maze(str(POINT_XML), U_MAZE, 1.0, WALL_HEIGHT)
    try:
        xml = _change(spec, mujoco.MjSpec.from_file(file)).to_xml()
    finally:
        os.unlink(file)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "maze.xml"
        path.write_text(xml, encoding="utf-8")
        return PointEnv(xml_file=str(path)), maze


def _change(spec: MazeSpec, model: mujoco.MjSpec) -> mujoco.MjSpec:
    """Remove the goal, add curtains and camera; for first_person a heading, and no ball around the eyes."""
    model.delete(model.site("target"))
    model.visual.quality.shadowsize = 0  # nothing casts a shadow: the only light is at the camera
    for number, curtain in enumerate(spec.curtains):
        model.worldbody.add_geom(
            name=f"curtain_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*curtain.center, WALL_HEIGHT + 0.05],
            size=[*curtain.half, 0.05],
            rgba=[0.25, 0.25, 0.35, 1.0],
            contype=0,
            conaffinity=0,
            group=2,
        )
    if not spec.first_person:
        model.worldbody.add_camera(name="view", pos=[0, 0, CAMERA_HEIGHT], fovy=TOP_FOVY)
        return model
    model.visual.map.znear = 0.001  # walls are as near as 0.1
    body = model.body("particle")
    body.add_joint(name="heading", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], damping=0.0)
    body.add_camera(name="view", pos=[0, 0, EYE_HEIGHT], quat=_AHEAD, fovy=EYE_FOVY)
    model.delete(model.site("particle_site"))
    return model
