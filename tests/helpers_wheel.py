"""A wheel of a source tree, without fetching anything."""

import subprocess
import sys
from pathlib import Path


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the project in a folder, and write it there."""
    build = "from setuptools import build_meta; print(build_meta.build_wheel('.'))"
    built = subprocess.run([sys.executable, "-c", build], cwd=folder, capture_output=True, text=True, check=True)
    return folder / built.stdout.splitlines()[-1]
