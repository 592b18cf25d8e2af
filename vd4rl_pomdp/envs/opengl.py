"""OpenGL setup and context handling. Import this before any module that may load OpenGL.

A process has one current OpenGL context, and renderers do not check that it is theirs: with another's or none current,
rendering silently returns a stale image. dm_control, mujoco and Gymnasium each track only their own contexts.
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

_TOO_LATE = "MUJOCO_GL" not in os.environ and bool({"dm_control._render", "mujoco.gl_context"} & sys.modules.keys())
"""Whether another import has already chosen how to render, by its own default."""
os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "glfw")  # macOS has only glfw
os.environ.setdefault("LP_NUM_THREADS", "1")  # software rendering scales with processes, not with threads
warnings.filterwarnings("ignore", module="glfw")  # it warns if there is no screen; rendering then raises an error


def _mesa_came_first() -> bool:
    """Whether the process has loaded the LLVM of Mesa's software renderer (known on Linux only)."""
    try:
        with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
            return "libLLVM" in maps.read()
    except OSError:
        return False


if "triton" in sys.modules or not _mesa_came_first():
    with contextlib.suppress(ImportError):  # not every PyTorch build includes Triton
        # Triton bundles its own LLVM. If PyTorch's optimisers import it after Mesa's software renderer has loaded
        # another LLVM, the process segfaults, so import it first.
        import triton  # noqa: F401

_LIBRARIES = ("OpenGL.", "glfw.", "mujoco.", "dm_control._render.", "gymnasium.envs.mujoco.mujoco_rendering.")
"""Prefixes of modules that load or use OpenGL."""
_VARIABLES = ("MUJOCO_", "PYOPENGL_", "PYGLFW_", "EGL_", "__EGL_", "LIBGL_", "MESA_", "GALLIUM_")
"""Prefixes of the environment variables that these modules and the drivers read."""


@contextlib.contextmanager
def gl_errors() -> Iterator[None]:
    """Turn any exception raised by OpenGL libraries in the block into a one-line UserError without further output."""
    try:
        yield
    except Exception as error:
        modules = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        if not any(f"{name}.".startswith(_LIBRARIES) for name in modules):
            raise
        _drop_half_made(error)
        if "current on another thread" in str(error):
            raise UserError("an environment renders only in the thread of its first frame: use it there") from error
        if _TOO_LATE:
            raise UserError(
                f"dm_control or mujoco was imported before vd4rl_pomdp.envs and chose another renderer "
                f"({first_line(error)}): import it after vd4rl_pomdp.envs, or set MUJOCO_GL before Python starts"
            ) from error
        read = (f"{k}={shlex.quote(v)}" for k, v in sorted(os.environ.items()) if k.startswith(_VARIABLES))
        raise UserError(
            f"cannot render with {', '.join(read)} ({first_line(error)}): correct or unset the variable at fault, or "
            "set MUJOCO_GL to egl (Debian: libegl1, libgl1, libgl1-mesa-dri), osmesa (libosmesa6) or glfw (needs a "
            "screen)"
        ) from error


def _drop_half_made(error: BaseException) -> None:
    """Free half-made contexts held by an error's frames now, silencing the errors that their `__del__` raises."""
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
"""Ids of processes that have rendered; a forked child inherits its parent's."""


def refuse_after_fork() -> None:
    """Call before rendering: raises UserError in a process forked after rendering, where OpenGL would hang."""
    _rendered_in.add(os.getpid())
    if len(_rendered_in) > 1:
        raise UserError(
            "this process was forked from one that has rendered, where OpenGL hangs: start processes by spawn, as in "
            "gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})"
        )


def keep_display() -> None:
    """Call after dm_control or mujoco has opened the EGL display: removes their exit handler, which closes it.

    They share the display, and closing it early breaks contexts that others still have to free.
    """
    if os.environ["MUJOCO_GL"] == "egl":
        from OpenGL import EGL  # type: ignore[import-untyped]

        atexit.unregister(EGL.eglTerminate)


def close_at_exit(drawing: Any) -> None:
    """Close `drawing`, a renderer with a context made by mujoco, at exit, before OpenGL itself is shut down."""
    keep_display()
    reference = weakref.ref(drawing)
    atexit.register(lambda: (alive := reference()) and alive.close())


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Disable garbage collection while rendering; enter it before making a context current.

    Otherwise the collector may free another environment's context, which leaves no context current.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
