"""Triton and Mesa's renderer in one process: loaded in the wrong order, they end it with a segmentation fault.

PyTorch's builds for GPUs bring Triton; beside a build without it the `dev` extra installs it.
"""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
RENDERING = ROOT / "vd4rl_pomdp" / "envs" / "rendering.py"


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
    return found


def test_one_module_alone_loads_opengl():
    sources = [
        p for folder in ("vd4rl_pomdp", "pretrain", "finetune", "baselines") for p in (ROOT / folder).rglob("*.py")
    ]
    loading = {p for p in [*sources, *(ROOT / "tests").rglob("*.py")] if imported(p) & {"dm_control", "mujoco"}}
    within = {ROOT / "vd4rl_pomdp" / "envs" / "maze_renderers.py"}  # mujoco.egl, after `rendering`
    assert loading - within == {RENDERING}


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed (it is for Linux)")
@pytest.mark.parametrize("script", ["stages", "environments"])
def test_no_stage_and_no_environment_ends_in_a_segmentation_fault(tmp_path, script):
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(tmp_path / "cache"), "PYTHONFAULTHANDLER": "1"}
    command = [sys.executable, HERE / "triton_script.py", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "as expected"
