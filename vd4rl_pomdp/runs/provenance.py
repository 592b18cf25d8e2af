"""Where a number comes from: versions, git commit, command line and machine."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = (
    "vd4rl-pomdp",
    "torch",
    "numpy",
    "mujoco",
    "dm-control",
    "h5py",
    "gymnasium",
    "gymnasium-robotics",
    "scikit-learn",
    "safetensors",
)


def versions() -> dict[str, str]:
    """Versions of Python and of every package that can change a number."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def git_commit() -> str:
    """Commit of the source tree, with `+` when it has uncommitted changes; empty outside a repository."""
    root = Path(__file__).resolve().parents[2]
    try:
        commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=True)
        dirty = subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=root, check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit.stdout.strip() + ("+" if dirty else "")


def machine() -> dict[str, Any]:
    """The hardware a run had: processor, cores, memory and GPU, without host or user names."""
    import torch

    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(memory / 2**30, 1),
        "gpu": gpu,
        "system": platform.system(),
    }


def command() -> str:
    """The command line, the program named as a user would type it."""
    script = Path(sys.argv[0])
    program = [script.name]
    if script.name in ("__main__.py", "-c"):  # python -m PACKAGE, and a worker's own command line
        program = ["vd4rl-pomdp", *([script.parent.name] if script.parent.name in ("pretrain", "finetune") else [])]
    return shlex.join([*program, *sys.argv[1:]])


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
