"""Render dm_control as in V-D4RL's frames: restore the old skybox, optionally use a cheaper shadow map; headless.

mujoco 3.2.0 changed the random stars of dm_control's sky, so an encoder pretrained on V-D4RL would be evaluated under
another sky: the sky of mujoco 3.1.6 is restored before the first render. mujoco 3.12 moved the origin of floor textures
from the floor's centre to its corner: this is undone, too.

Only this module imports mujoco and dm_control, after `envs.opengl` has prepared for OpenGL.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import FRAME_SIZE
from vd4rl_pomdp.envs.opengl import gl_errors, keep_display, refuse_after_fork, undisturbed
from vd4rl_pomdp.envs.pixels import Render

try:
    with gl_errors():  # both load the OpenGL library named by MUJOCO_GL and fail in many ways if it is missing
        import mujoco
        from dm_control import suite as suite  # for the other modules
        from dm_control.mujoco import Camera
except ImportError as _error:
    if _error.name == "dm_control":
        raise UserError("dm-control is not installed: `pip install --no-deps dm-control==1.0.44`") from _error
    raise
keep_display()

_SKYBOX = Path(__file__).parent / "assets" / "skybox.npz"
TRIED_MUJOCO = ((3, 3), (3, 18))
"""Lowest supported version and first unsupported one, as (major, minor)."""
_TEXTURE_AT_CORNER = (3, 12)
_FAR = 50.0
_FAST_SHADOW_SIZE = 512
_SAME_SKY = 0.9
"""Least share of equal bytes of dm_control's sky in two versions of mujoco, which differ in its stars (2%)."""


def check_mujoco(version: str = mujoco.__version__) -> None:
    """Raise UserError for a mujoco version whose pixels were not compared with the data's."""
    low, high = TRIED_MUJOCO
    if not low <= _numbers(version) < high:
        raise UserError(
            f"mujoco {version} has not been compared with the data's pixels (tested: {low[0]}.{low[1]} to below "
            f"{high[0]}.{high[1]}); install the tested pair with `pip install 'dm-control==1.0.44' 'mujoco==3.11.0'`"
        )


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:2])


def prepare(physics: Any, render: Render, size: int) -> None:
    """Restore the old sky and floors, and set the sizes of the shadow map and of the offscreen buffer.

    Call it before the first render of `physics`. The buffer, 640x480 by default, is cleared for every frame, so it is
    reduced to `size` x `size`.
    """
    model, sky = physics.model, _sky()
    for number in np.flatnonzero(np.asarray(model.tex_type) == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        start = model.tex_adr[number]
        stored = model.tex_width[number] * model.tex_height[number] * model.tex_nchannel[number]
        pixels = model.tex_data[start : start + stored]
        if stored == sky.size and (pixels == sky).mean() > _SAME_SKY:  # else it is a user's own
            pixels[:] = sky
    if _numbers(mujoco.__version__) >= _TEXTURE_AT_CORNER:
        _center_floors(model)
    model.vis.global_.offwidth = model.vis.global_.offheight = size
    if render == "fast":
        model.vis.quality.shadowsize = _FAST_SHADOW_SIZE


def _center_floors(model: Any) -> None:
    """Align the textures of planes as mujoco did before 3.12.

    For half-length h and r repeats per unit of length, the texture's middle used to lie at the plane's centre; now its
    edge lies at the plane's corner. So it must move by (r h + 1) / 2 of its size. Rolling the texture changes its
    mipmaps slightly; a square floor that ends out of sight is therefore enlarged instead, until that number is whole.
    """
    moved = set()
    for plane in np.flatnonzero(np.asarray(model.geom_type) == mujoco.mjtGeom.mjGEOM_PLANE):
        material, half = model.geom_matid[plane], model.geom_size[plane, :2]
        if material < 0:
            continue
        texture, repeats = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB], model.mat_texrepeat[material]
        if texture < 0 or texture in moved or model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
            continue
        if (half <= 0).any() or (repeats <= 0).any():
            continue  # infinite planes did not change
        uniform = model.mat_texuniform[material]
        if uniform and (repeats == 1).all() and half.min() > _FAR and not model.geom_pos[plane, :2].any():
            model.geom_size[plane, :2] = 2 * np.ceil((half - 1) / 2) + 1
            continue
        across, down = (repeats * (half if uniform else 1.0) + 1) / 2
        shape = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
        start = model.tex_adr[texture]
        pixels = model.tex_data[start : start + np.prod(shape)]
        shift = round(down * shape[0]), round(across * shape[1])
        pixels[:] = np.roll(pixels.reshape(shape), shift, (0, 1)).ravel()
        moved.add(texture)


class FrameCamera:
    """Renders a simulator's frames in V-D4RL's format; the OpenGL context is created at the first frame.

    It keeps its camera: `physics.render` sets one up for every frame, which adds a sixth of the rendering time.
    """

    def __init__(self, physics: Any, size: int = FRAME_SIZE, camera: int = 0) -> None:
        self._physics, self._size, self._number = physics, size, camera
        self._camera: Camera | None = None

    def frame(self) -> np.ndarray:
        """Frame of the current state: (3, size, size) uint8."""
        refuse_after_fork()
        with gl_errors(), undisturbed():
            if self._camera is None:
                self._camera = Camera(self._physics, self._size, self._size, self._number)
            context = self._physics.contexts.gl
            with context.make_current() as thread:  # dm_control skips this if it was the last of its own contexts,
                thread.call(context._platform_make_current)  # but mujoco or Gymnasium may have made theirs current
            image = self._camera.render()
        return np.array(image.transpose(2, 0, 1), order="C")  # a copy: the camera reuses its buffer

    def close(self) -> None:
        """Free the OpenGL context; the next frame creates another."""
        self._camera = None
        if self._physics._contexts:  # `physics.free` would free the simulator, too
            self._physics._free_rendering_contexts()


@cache
def _sky() -> np.ndarray:
    """Bytes of the skybox texture of mujoco 3.1.6: 11,520,000 uint8 (six faces of 800x800 RGB)."""
    with np.load(_SKYBOX) as file:
        return file["sky"]


def gl_strings() -> dict[str, str]:
    """Vendor and renderer of the current GL context; empty strings before the first render."""
    try:
        from OpenGL import GL  # type: ignore[import-untyped]

        values = [GL.glGetString(name) for name in (GL.GL_VENDOR, GL.GL_RENDERER)]
    except (ImportError, AttributeError):
        values = [None, None]
    vendor, renderer = (value.decode() if value else "" for value in values)
    return {"gl_vendor": vendor, "gl_renderer": renderer}


def frames_hash(frames: np.ndarray) -> str:
    """Short hash of a batch of frames."""
    return hashlib.blake2b(frames.tobytes(), digest_size=8).hexdigest()
