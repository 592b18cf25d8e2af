"""What must happen before any environment loads OpenGL, and while it draws; to be imported before whatever may load it.

One OpenGL context of a process is current, and what draws does not check that it is its own: into another's, or none,
nothing is drawn, and the picture read is an old one. dm_control, mujoco and Gymnasium know their own contexts alone.
"""

import contextlib
import gc
import os
import sys
from collections.abc import Iterator

os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "glfw")  # macOS and Windows know no other
os.environ.setdefault("LP_NUM_THREADS", "1")  # software rendering scales by processes, not by threads

with contextlib.suppress(ImportError):  # not every PyTorch brings it
    # Triton carries an LLVM of its own. PyTorch's optimisers import it, and the process ends in a segmentation fault
    # if Mesa's software renderer has loaded another LLVM before.
    import triton  # noqa: F401


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
