#!/usr/bin/env bash
# One would guess: `pip install dm-control` gives a pair of packages that work together.
# What happens: dm-control sets no upper bound on mujoco. Version 1.0.50 takes mujoco 4.0.0, imports, and fails at the
# first `suite.load`, since it asks for a field that mujoco 4 no longer has.
# For this field: whoever depends on dm-control must bound mujoco itself, `mujoco<4` here.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import subprocess
import sys

load = "from dm_control import suite; suite.load('walker', 'walk').reset(); print('works')"
seen = {}
for version in ("4.0.0", "3.17.0"):
    target = f"{sys.argv[1]}/{version}"
    subprocess.run([sys.executable, "-m", "venv", target], check=True)
    python = f"{target}/bin/python"
    wanted = ["dm-control==1.0.50", f"mujoco=={version}", "numpy==2.4.6"]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *wanted], check=True)  # pip sees no conflict
    end = subprocess.run([python, "-c", load], capture_output=True, text=True, env={"MUJOCO_GL": "disabled"})
    seen[version] = (end.stdout + end.stderr).strip().splitlines()[-1]
    print(f"dm-control 1.0.50 with mujoco {version}: {seen[version]}")
assert "AttributeError" in seen["4.0.0"] and seen["3.17.0"] == "works", "the pair behaves in another way"
PY
