#!/usr/bin/env bash
# One would guess: each `camera.render()` of dm_control returns a picture of its own, ready for torch.
# What happens: a `Camera` that is kept returns a view into its one buffer, upside down in memory: the next render
# changes every picture returned before, and `torch.from_numpy` refuses the negative stride. `physics.render()` makes a
# new camera (and buffer) per call, which is why code that uses it works until someone speeds it up by keeping the
# camera.
# For this field: a list of frames in which all rows are the last one. Copy each picture.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-control==1.0.44 mujoco==3.11.0 numpy==2.4.6
export MUJOCO_GL="${MUJOCO_GL:-egl}"
"$tmp/venv/bin/python" -c "import mujoco; mujoco.GLContext(8, 8).free()" 2> "$tmp/gl" || {
    tail -1 "$tmp/gl"
    echo "skipped, nothing seen: needs libegl1, libgl1 and libgl1-mesa-dri, or libosmesa6 and MUJOCO_GL=osmesa"
    exit 77
}
"$tmp/venv/bin/python" - "$tmp" << 'PY'
from importlib.metadata import version

import numpy as np
from dm_control import mujoco, suite

print("dm-control", version("dm-control"), "mujoco", version("mujoco"))
env = suite.load("cheetah", "run", task_kwargs={"random": 0})
env.reset()
camera = mujoco.Camera(env.physics, height=84, width=84, camera_id=0)
frames, copies = [], []
for _ in range(5):
    env.step(np.ones(6))
    frames.append(camera.render())
    copies.append(frames[-1].copy())


def different(pictures):
    return len({picture.tobytes() for picture in pictures})


print("five frames of one camera:", different(frames), "different; their copies:", different(copies), "different")
print("strides:", frames[0].strides, "owns its data:", frames[0].flags.owndata)
assert different(frames) == 1 and different(copies) == 5 and frames[0].strides[0] < 0, "pictures are kept apart"
env.physics.free()
PY
