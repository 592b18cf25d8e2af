#!/usr/bin/env bash
# One would guess: images of Meta-World's named cameras show the table from above with the floor below; if one is upside
# down, `frame[::-1]` puts it right.
# What happens: the four corner cameras, among them `corner2`, the usual choice for learning from pixels, hang upside
# down (the image's upward direction has z from -0.53 to -0.96), while `behindGripper` does not (0.98). Such an image is
# turned by 180 degrees, so that flipping its rows mirrors the scene, left and right exchanged; `frame[::-1, ::-1]` is
# right.
# For this field: encoders pretrained on upright photographs see an inverted scene, or one with a left-handed robot, and
# results of two groups that put it right in two ways are not about the same pixels.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet metaworld==3.1.1 gymnasium==1.4.0 mujoco==3.3.0 numpy==2.4.6 packaging==26.3
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import gymnasium
import metaworld  # noqa: F401, registers the environments
import numpy as np

print("metaworld", version("metaworld"), "gymnasium", gymnasium.__version__)
env = gymnasium.make("Meta-World/MT1", env_name="drawer-open-v3", seed=0)
env.reset()
model, data = env.unwrapped.model, env.unwrapped.data
triangle = np.array([[-0.1, 0.5, 0], [0.1, 0.5, 0], [0, 0.7, 0]])  # on the table, counter-clockwise seen from above


def turn(points):
    """Twice the signed area: positive for counter-clockwise points; the second coordinate points up."""
    (ax, ay), (bx, by) = points[1] - points[0], points[2] - points[0]
    return ax * by - ay * bx


heights = {}
for index in range(model.ncam):
    name = model.camera(index).name
    axes = data.cam_xmat[index].reshape(3, 3)  # columns: right, up and backwards of the image, in the world
    heights[name] = axes[2, 1]
    if not name.startswith("corner"):
        print(f"{name}: the image's upward direction has z = {heights[name]:.2f}")
        continue
    right, up, back = ((triangle - data.cam_xpos[index]) @ axes).T
    seen = np.stack([right, up], 1) / -back[:, None]
    flipped, turned = turn(seen * [1, -1]) < 0, turn(-seen) < 0
    print(f"{name}: z = {heights[name]:.2f}; mirrored as it is: {turn(seen) < 0}, with rows flipped: {flipped}, "
          f"turned by 180 degrees: {turned}")
    assert heights[name] < -0.5, "the camera is upright"
    assert turn(seen) > 0 and flipped and not turned, "the image is mirrored"
assert heights["behindGripper"] > 0.9 and len(heights) == 7
PY
