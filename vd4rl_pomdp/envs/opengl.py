"""What must happen before any environment loads OpenGL; to be imported before whatever may load it."""

import contextlib
import os

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "1")  # software rendering scales by processes, not by threads

with contextlib.suppress(ImportError):  # not every PyTorch brings it
    # Triton carries an LLVM of its own. PyTorch's optimisers import it, and the process ends in a segmentation fault
    # if Mesa's software renderer has loaded another LLVM before.
    import triton  # noqa: F401
