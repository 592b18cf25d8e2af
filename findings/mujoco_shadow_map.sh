#!/usr/bin/env bash
# One would guess: an 84-pixel frame costs less than a 168-pixel one, and `physics.model.vis.quality` can be lowered to
# speed up frames at any time.
# What happens, without a GPU: at least two fifths of a small frame's time go to the shadow map, whose 2048 x 2048
# pixels do not follow the frame's size: four times the pixels cost only a sixth more. A map of 512 saves these two fifths and
# changes the frame by a hundredth of one of 255; but its size is read when the first frame is drawn, and later changes
# are ignored without an error.
# For this field: rendering dominates the evaluation of pixel policies on CPUs. Set it before `env.reset()`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet dm-control==1.0.44 mujoco==3.11.0 numpy==2.4.6
export MUJOCO_GL="${MUJOCO_GL:-egl}" LP_NUM_THREADS=1
"$tmp/venv/bin/python" -c "import mujoco; mujoco.GLContext(8, 8).free()" 2> "$tmp/gl" || {
    tail -1 "$tmp/gl"
    echo "skipped, nothing seen: needs libegl1, libgl1 and libgl1-mesa-dri, or libosmesa6 and MUJOCO_GL=osmesa"
    exit 77
}
"$tmp/venv/bin/python" - << 'PY'
import time
from importlib.metadata import version

import numpy as np
from dm_control import suite

print("dm-control", version("dm-control"), "mujoco", version("mujoco"))


def start(size=84, shadow=None):
    """A physics with its first frame drawn, and a function that draws it."""
    physics = suite.load("cheetah", "run", task_kwargs={"random": 0}).physics
    physics.model.vis.global_.offwidth = physics.model.vis.global_.offheight = size
    if shadow:
        physics.model.vis.quality.shadowsize = shadow
    physics.forward()
    physics.render(size, size, camera_id=0)
    return physics, lambda: physics.render(size, size, camera_id=0)


def measure(draw):
    """CPU milliseconds of a frame, the least of 40, and the frame."""
    seconds = []
    for _ in range(40):
        begun = time.process_time()
        frame = draw()
        seconds.append(time.process_time() - begun)
    return 1e3 * min(seconds), frame.astype(float)


physics, draw = start()
size = physics.model.vis.quality.shadowsize
default, frame = measure(draw)
physics.model.vis.quality.shadowsize = 512
late, unchanged = measure(draw)
larger, _ = measure(start(168)[1])
early, small = measure(start(shadow=512)[1])
moved = np.abs(small - frame).mean()
print(f"shadow map of {size}: 84 pixels {default:.1f} ms, 168 pixels {larger:.1f} ms")
print(f"of 512: set after the first frame {late:.1f} ms, before it {early:.1f} ms; frames differ by {moved:.2f} of 255")
assert size == 2048, "another default"
assert (unchanged == frame).all() and late > 0.85 * default, "a late change counts"
assert early < 0.8 * default and 0 < moved < 0.1, "the shadow map is cheap"
assert larger < 1.5 * default, "the frame's size decides"
PY
