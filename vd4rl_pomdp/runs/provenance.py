"""Where a result comes from: versions, git commit, command line and machine."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Sequence
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
CONTINUED = "continued"
"""Key in machine.json for the later parts of a run that was resumed with other hardware, commit or versions."""
COMMIT_FILE = "vd4rl_pomdp/commit.txt"
"""File in which a wheel stores the commit it was built from, relative to the installed packages."""


def versions() -> dict[str, str]:
    """Versions of Python and all packages that can affect results."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def git_commit() -> str:
    """Commit of the running code, with `+` for uncommitted changes: from the checkout, else as stored by `setup.py`.

    Empty if unknown. The commit of an unrelated repository around an installed package is ignored.
    """
    root = Path(__file__).resolve().parents[2]
    if commit := checkout_commit(root):
        return commit
    try:
        return (root / COMMIT_FILE).read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def checkout_commit(root: Path) -> str:
    """Commit of a source tree if it is the root of this project's git checkout; else empty."""
    try:
        project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["name"]
        if project != PACKAGES[0] or Path(_git(root, "rev-parse", "--show-toplevel")).resolve() != root:
            return ""
        dirty = subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=root, check=False).returncode
        return _git(root, "rev-parse", "HEAD") + ("+" if dirty else "")
    except (OSError, ValueError, KeyError, TypeError, subprocess.CalledProcessError):
        return ""


def _git(root: Path, *words: str) -> str:
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()


_CPUINFO = Path("/proc/cpuinfo")


def _processor() -> str:
    """The processor's model; on ARM Linux, which names none, the implementer and part of its first core."""
    if platform.system() == "Darwin":
        words = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    stated: dict[str, str] = {}
    if _CPUINFO.exists():
        for line in _CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            stated.setdefault(name.strip(), value.strip())
    if "model name" not in stated and {"CPU implementer", "CPU part"} <= stated.keys():
        return f"{platform.machine()} {stated['CPU implementer']}/{stated['CPU part']}"
    return stated.get("model name") or platform.processor() or platform.machine()


def machine(device: str = "auto") -> dict[str, Any]:
    """Hardware of a run on a device: processor, cores, memory and GPU. No host or user names."""
    import torch  # here, since setup.py loads this file where nothing is installed

    from vd4rl_pomdp.core.hardware import bf16_kernels, pick_device

    used = pick_device(device)
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "bf16_kernels": bf16_kernels(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": torch.cuda.get_device_name(used) if used.type == "cuda" else None,
        "system": platform.system(),
    }


def command(stage: str = "", words: Sequence[str] | None = None) -> str:
    """The command line, with the program's name as a user would type it.

    Args:
        stage: command of the one run wanted, if the command line starts several.
        words: that run's arguments; None: all of the command line's.
    """
    script = Path(sys.argv[0])
    program = [*["python"] * (script.suffix == ".py"), script.name]
    if script.name in ("__main__.py", "-c"):  # python -m vd4rl_pomdp, or a spawned worker
        program = ["vd4rl-pomdp"]
    given = sys.argv[1:] if words is None else [*(word for word in sys.argv[1:2] if word == stage), *words]
    return shlex.join([*program, *given])
