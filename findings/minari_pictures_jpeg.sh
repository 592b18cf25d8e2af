#!/usr/bin/env bash
# One would guess: Minari, a format for data sets, gives back the pictures that it was given.
# What happens: uint8 observations of the shape (H, W, 3) and (H, W) become JPEG by default, silently lossy; (3, H, W)
# is kept to the byte. Stacks (H, W, 9) and greyscale (H, W, 1) are taken for pictures too, and saving them fails.
# For this field: two layouts of one data set train on different pixels. Pass `jpeg_encoding=False` to DataCollector.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "minari[hdf5,create]==0.5.4" \
    gymnasium==1.4.0 numpy==2.4.6 h5py==3.16.0 pillow==13.0.0
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys

os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium
import minari
import numpy as np

print("minari", minari.__version__, "gymnasium", gymnasium.__version__)


class Env(gymnasium.Env):
    def __init__(self, shape):
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        # hard edges, as a simulator draws them
        red, blue = np.uint8([200, 30, 30]), np.uint8([30, 30, 200])
        chess = np.where((np.indices((84, 84)).sum(0) // 7 % 2)[..., None], red, blue)
        pictures = {(3, 84, 84): chess.transpose(2, 0, 1), (84, 84): chess[..., 0], (84, 84, 1): chess[..., :1]}
        pictures |= {(84, 84, 3): chess, (84, 84, 9): np.concatenate([chess] * 3, 2)}
        self.picture = pictures[shape]

    def reset(self, *, seed=None, options=None):
        return self.picture.copy(), {}

    def step(self, action):
        return self.picture.copy(), 0.0, False, True, {}


def largest_change(shape, name, **options):
    env = Env(shape)
    collector = minari.DataCollector(env, **options)
    collector.reset(seed=0)
    try:
        collector.step(env.action_space.sample())
        author = {"author": "a", "author_email": "a@example.org", "code_permalink": "none", "algorithm_name": "none"}
        collector.create_dataset(f"{name}-v0", **author)
    except TypeError as error:
        return f"{type(error).__name__}: {error}"
    stored = next(iter(minari.load_dataset(f"{name}-v0").iterate_episodes())).observations
    return int(np.abs(np.asarray(stored)[0].astype(int) - env.picture).max())


shapes = [(84, 84, 3), (84, 84), (3, 84, 84), (84, 84, 9), (84, 84, 1)]
seen = {shape: largest_change(shape, f"set{i}") for i, shape in enumerate(shapes)}
for shape, change in seen.items():
    print(shape, "largest change of a pixel:" if isinstance(change, int) else "not saved:", change)
raw = largest_change((84, 84, 3), "raw", jpeg_encoding=False)
print((84, 84, 3), "jpeg_encoding=False:", raw)
assert seen[84, 84, 3] > 10 and seen[84, 84] > 0 and seen[3, 84, 84] == 0 and raw == 0, "pictures are kept to the byte"
assert "TypeError" in str(seen[84, 84, 9]) and "TypeError" in str(seen[84, 84, 1]), "other channels are saved"
PY
