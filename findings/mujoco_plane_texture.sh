#!/usr/bin/env bash
# One would guess: a minor release of mujoco draws the same model in the same state as the one before.
# What happens: from 3.12.0 on the texture of a plane begins at the plane's corner, not at its centre. Half of the
# pixels of a checkered floor, as every task of dm_control's suite has one, change by more than 8 of 255; physics and
# rewards do not.
# For this field: an encoder trained on pictures of 3.11 or older is evaluated on another floor; check pixels, not
# returns.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet mujoco==3.11.0 numpy==2.4.6
export MUJOCO_GL="${MUJOCO_GL:-egl}"
"$tmp/venv/bin/python" -c "import mujoco; mujoco.GLContext(8, 8).free()" 2> "$tmp/gl" || {
    tail -1 "$tmp/gl"
    echo "skipped, nothing seen: needs libegl1, libgl1 and libgl1-mesa-dri, or libosmesa6 and MUJOCO_GL=osmesa"
    exit 77
}
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import subprocess
import sys

import numpy as np

draw = """
import mujoco, numpy as np, sys
model = mujoco.MjModel.from_xml_string('''<mujoco><asset>
  <texture name="grid" type="2d" builtin="checker" rgb1=".1 .2 .3" rgb2=".2 .3 .4" width="300" height="300"/>
  <material name="grid" texture="grid" texrepeat="1 1" texuniform="true"/></asset><worldbody>
  <light pos="0 0 3"/><camera name="top" pos="0 0 3"/><geom type="plane" size="2.3 2.3 .1" material="grid"/>
  </worldbody></mujoco>''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 84, 84)
renderer.update_scene(data, "top")
np.save(sys.argv[1], renderer.render())
renderer.close()
"""
pictures = {}
for version in ("3.1.6", "3.11.0", "3.12.0"):
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", f"mujoco=={version}"], check=True)
    subprocess.run([sys.executable, "-c", draw, f"{sys.argv[1]}/{version}.npy"], check=True)
    pictures[version] = np.load(f"{sys.argv[1]}/{version}.npy").astype(int)
for older, newer, same in (("3.1.6", "3.11.0", True), ("3.11.0", "3.12.0", False)):
    off = np.abs(pictures[older] - pictures[newer])
    share = (off.max(-1) > 8).mean()
    print(f"mujoco {older} and {newer}: mean difference {off.mean():.2f} of 255, {share:.0%} of the pixels above 8")
    assert (share < 0.01) if same else (share > 0.2), "the floor is drawn in another way"
PY
