#!/usr/bin/env bash
# One would guess: combining sets that were stored with `jpeg_encoding=False` keeps their pictures.
# What happens: `minari.combine_datasets` (and `minari combine`) makes the new set with the default, JPEG: (H, W, 3)
# pictures that were kept to the byte until then are lossy in it, silently.
# For this field: a set and its union with another train on different pixels. Append episodes to one of them instead.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "minari[hdf5]==0.5.4" gymnasium==1.4.0 numpy==2.4.6 h5py==3.16.0 pillow==13.0.0
"$tmp/venv/bin/python" -W ignore - "$tmp" << 'PY'
import os
import sys

os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

print("minari", minari.__version__)
# hard edges, as a simulator draws them
chess = np.indices((84, 84)).sum(0) // 7 % 2
pictures = np.where(chess[..., None], np.uint8([200, 30, 30]), np.uint8([30, 30, 200]))[None].repeat(3, 0)
episode = EpisodeBuffer(
    observations=pictures,
    actions=np.zeros((2, 1), np.float32),
    rewards=np.ones(2),
    terminations=np.zeros(2, bool),
    truncations=np.array([False, True]),
)
spaces = {
    "observation_space": gymnasium.spaces.Box(0, 255, (84, 84, 3), np.uint8),
    "action_space": gymnasium.spaces.Box(-1, 1, (1,), np.float32),
}
raw = [minari.create_dataset_from_buffers(f"{i}-v0", [episode], jpeg_encoding=False, **spaces) for i in range(2)]
both = minari.combine_datasets(raw, "both-v0")
change = [int(np.abs(one[0].observations.astype(int) - pictures).max()) for one in (raw[0], both)]
print("largest change of a pixel: stored", change[0], "combined", change[1])
assert change[0] == 0 and change[1] > 10, "the combined set keeps the pictures"
PY
