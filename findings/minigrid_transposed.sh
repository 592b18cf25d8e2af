#!/usr/bin/env bash
# One would guess: MiniGrid's observation `image`, (7, 7, 3), and the picture of the same view that
# `RGBImgPartialObsWrapper` gives have the same orientation: rows first, like any image.
# What happens: `image` is indexed by column, then row: the transposed picture, in 50 views of 50. Shapes are equal.
# For this field: an encoder, a decoder or a mask made for one is wrong for the other; a shift or flip that moves the
# picture sideways moves `image` towards or away from the agent. Swap the first two axes of one of them.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet minigrid==3.2.0 gymnasium==1.4.0 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import gymnasium
import minigrid  # noqa: F401, registers the environments
import numpy as np
from minigrid.core.constants import OBJECT_TO_IDX
from minigrid.wrappers import RGBImgPartialObsWrapper

print("minigrid", version("minigrid"), "gymnasium", gymnasium.__version__)
plain, picture = (gymnasium.make("MiniGrid-DoorKey-8x8-v0") for _ in range(2))
picture = RGBImgPartialObsWrapper(picture, tile_size=8)
upright = transposed = 0
for seed in range(50):
    cells = plain.reset(seed=seed)[0]["image"][..., 0]
    tiles = picture.reset(seed=seed)[0]["image"].reshape(7, 8, 7, 8, 3)[:, 3:5, :, 3:5].astype(int)  # middle of each
    drawn = (np.ptp(tiles, axis=(1, 3, 4)) == 0) & (tiles[:, 0, :, 0].mean(-1) > 120)  # plain light grey: a wall
    walls = cells == OBJECT_TO_IDX["wall"]
    upright += np.array_equal(walls, drawn)
    transposed += np.array_equal(walls.T, drawn)
    if seed == 0:
        for title, rows in (("walls in `image`:", walls), ("walls in the picture:", drawn)):
            print(title, *("".join("#" if cell else "." for cell in row) for row in rows), sep="\n")
print(f"of 50 views, `image` equals the picture in {upright}, transposed in {transposed}")
assert transposed > 40 and upright < 10, "the orientations are equal"
PY
