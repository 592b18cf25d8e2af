#!/usr/bin/env bash
# One would guess: the same XML compiles to the same sky texture in every release of mujoco 3.
# What happens: from 3.2.0 on `mark="random"`, which dm_control's sky uses, sets its stars from another random
# sequence.
# For this field: pictures recorded with an older mujoco (V-D4RL's) and those of an environment with a newer one differ
# at equal states, and nothing is raised. A trained encoder sees another background.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import hashlib
import subprocess
import sys

compile_sky = """
import mujoco, numpy as np, sys
model = mujoco.MjModel.from_xml_string('''<mujoco><asset><texture name="sky" type="skybox" builtin="gradient"
  rgb1=".4 .6 .8" rgb2="0 0 0" width="200" height="200" mark="random" markrgb="1 1 1"/></asset></mujoco>''')
data = model.tex_data if hasattr(model, "tex_data") else model.tex_rgb  # renamed in 3.2
sys.stdout.buffer.write(np.asarray(data).tobytes())
"""
skies = {}
for version in ("3.1.6", "3.2.0", "3.11.0"):
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", f"mujoco=={version}"], check=True)
    skies[version] = subprocess.run([sys.executable, "-c", compile_sky], check=True, capture_output=True).stdout
    sky = skies[version]
    stars = sum(sky[i : i + 3] == b"\xff\xff\xff" for i in range(0, len(sky), 3))
    print(f"mujoco {version}: {len(sky)} bytes of sky, sha256 {hashlib.sha256(sky).hexdigest()[:12]}, {stars} stars")
assert len(skies["3.1.6"]) == len(skies["3.2.0"]) and skies["3.1.6"] != skies["3.2.0"], "the sky is the same"
assert skies["3.2.0"] == skies["3.11.0"], "the sky has changed again"
PY
