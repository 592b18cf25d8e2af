"""What must happen before any environment loads OpenGL, and while it draws; to be imported before whatever may load it.

One OpenGL context of a process is current, and what draws does not check that it is its own: into another's, or none,
nothing is drawn, and the picture read is an old one. dm_control, mujoco and Gymnasium know their own contexts alone.
"""

import atexit
import contextlib
import gc
import os
import shlex
import sys
import traceback
import warnings
import weakref
from collections.abc import Iterator
from typing import Any

from vd4rl_pomdp.core.errors import UserError, first_line

os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "glfw")  # macOS and Windows know no other
os.environ.setdefault("LP_NUM_THREADS", "1")  # software rendering scales by processes, not by threads
warnings.filterwarnings("ignore", module="glfw")  # where there is no screen it warns, and what draws then says so

with contextlib.suppress(ImportError):  # not every PyTorch brings it
    # Triton carries an LLVM of its own. PyTorch's optimisers import it, and the process ends in a segmentation fault
    # if Mesa's software renderer has loaded another LLVM before.
    import triton  # noqa: F401

_LIBRARIES = ("OpenGL.", "glfw.", "mujoco.", "dm_control._render.", "gymnasium.envs.mujoco.mujoco_rendering.")
"""Modules that load OpenGL or draw with it."""
_VARIABLES = ("MUJOCO_", "PYOPENGL_", "PYGLFW_", "EGL_", "__EGL_", "LIBGL_", "MESA_", "GALLIUM_")
"""What the environment variables begin with that these and the drivers below them read."""


@contextlib.contextmanager
def gl_errors() -> Iterator[None]:
    """Turn whatever OpenGL's libraries raise within the block into one line, and let them print nothing beside it."""
    try:
        yield
    except Exception as error:
        modules = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        if not any(f"{name}.".startswith(_LIBRARIES) for name in modules):
            raise
        _drop_half_made(error)
        read = {name: value for name, value in sorted(os.environ.items()) if name.startswith(_VARIABLES)}
        told = ", ".join(f"{name}={shlex.quote(value)}" for name, value in read.items())
        raise UserError(
            f"cannot render with {told} ({first_line(error)}): correct or unset the variable at fault, or set "
            "MUJOCO_GL to egl (Debian: libegl1, libgl1, libgl1-mesa-dri), osmesa (libosmesa6) or glfw (needs a "
            "screen)"
        ) from error


def _drop_half_made(error: BaseException) -> None:
    """Free now what an error's frames hold: contexts that failed while they were made raise again as they are freed."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        cause: BaseException | None = error
        while cause is not None:
            traceback.clear_frames(cause.__traceback__)
            cause = cause.__context__
        gc.collect()
    finally:
        sys.unraisablehook = hook


_rendered_in: set[int] = set()
"""Process that has rendered; a forked one inherits its parent's."""


def refuse_after_fork() -> None:
    """To be called before rendering: OpenGL waits for ever in a process forked from one that has rendered."""
    _rendered_in.add(os.getpid())
    if len(_rendered_in) > 1:
        raise UserError(
            "this process was forked from one that has rendered, where OpenGL hangs: start processes by spawn, as in "
            "gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})"
        )


def keep_display() -> None:
    """Leave closing the EGL display to the process's end; to be called once dm_control or mujoco has opened it.

    They share it, and the exit handler of either would close it while others still free their contexts.
    """
    if os.environ["MUJOCO_GL"] == "egl":
        from OpenGL import EGL  # type: ignore[import-untyped]

        atexit.unregister(EGL.eglTerminate)


def close_at_exit(drawing: Any) -> None:
    """To be called with what has made a context by mujoco's own means: it is closed before OpenGL itself ends."""
    keep_display()
    atexit.register(_close, weakref.ref(drawing))


def _close(drawing: weakref.ref[Any]) -> None:
    alive = drawing()
    if alive is not None:
        alive.close()


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold the garbage collector back, to be entered before OpenGL is told where to draw.

    An environment that it frees takes its context along and leaves none current.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
