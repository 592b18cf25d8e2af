#!/usr/bin/env bash
# One would guess: `pip install --upgrade mujoco` in a working environment gives a working mujoco.
# What happens: mujoco 4 is split into `mujoco` and `mujoco-core`, which own the same folder. pip installs the new core
# first, then removes the old package and with it files of the new one. pip reports success; `import mujoco` fails.
# For this field: an upgrade across 3 to 4 needs a new environment (or --force-reinstall of both parts).
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import subprocess
import sys


def python(*words):
    return subprocess.run([sys.executable, *words], capture_output=True, text=True)


assert python("-c", "import mujoco").returncode == 0
upgrade = python("-m", "pip", "install", "--quiet", "--upgrade", "mujoco==4.0.0")
imported = python("-c", "import mujoco")
print("upgrade from 3.17.0 to 4.0.0: pip ends with", upgrade.returncode)
print("then import mujoco:", imported.stderr.strip().splitlines()[-2:] or "works")
assert upgrade.returncode == 0 and "mujoco-core" in imported.stderr, "the upgrade works"
repair = ["--force-reinstall", "--no-deps", "mujoco==4.0.0", "mujoco-core==4.0.0"]
assert python("-m", "pip", "install", "--quiet", *repair).returncode == 0
again = python("-c", "import mujoco")
print("both parts installed again:", "works" if again.returncode == 0 else again.stderr.strip().splitlines()[-1])
assert again.returncode == 0
PY
