"""OpenGL in several processes and together with Triton, in a subprocess, so that a hang or crash ends no other test.

PyTorch's GPU builds include Triton; otherwise the `dev` extra installs it.
"""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).with_name("processes_script.py")


def test_vector_environments_work_or_are_rejected(tmp_path):
    shown = tmp_path / "shown.txt"
    with shown.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", SCRIPT], stdout=file, stderr=file, start_new_session=True
        )
    try:
        assert process.wait(timeout=240) == 0, shown.read_text()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert shown.read_text().splitlines()[-1] == "as expected"


FIRST = """
from dm_control import suite
import gymnasium, vd4rl_pomdp.envs
print(gymnasium.make("vd4rl_pomdp/WalkerWalk-v0").reset(seed=0)[0].shape)
"""


def test_dm_control_may_be_imported_first():
    """It loads the renderer's LLVM before Triton's, or chooses a renderer of its own."""
    without = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    ends = [
        subprocess.run([sys.executable, "-c", FIRST], env=without | more, capture_output=True, text=True)
        for more in ({"MUJOCO_GL": "egl"}, {})
    ]
    assert ends[0].stdout == "(9, 84, 84)\n", ends[0].stderr
    assert "import it after vd4rl_pomdp.envs, or set MUJOCO_GL before Python starts" in ends[1].stderr
