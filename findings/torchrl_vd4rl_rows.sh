#!/usr/bin/env bash
# One would guess: TorchRL's loader of V-D4RL gives transitions (o_t, a_t, r_t, o_{t+1}) within episodes.
# What happens: V-D4RL's row t holds the action that LED to frame t (row 0 of an episode: zeros). The loader pairs row
# t's action and reward with the step from frame t to frame t+1, one late, makes a transition across each end of an
# episode and sets no done flag. A small file in V-D4RL's layout stands in for the download; the rest is the loader's
# own code.
# For this field: the pair (o_t, a) is the previous action: behaviour cloning and inverse models learn another
# function.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchrl==0.14.1 tensordict==0.14.3 \
    h5py==3.16.0 numpy==2.4.6 huggingface_hub==2.4.0 tqdm
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import sys
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
from torchrl.data.datasets.vd4rl import VD4RLExperienceReplay as Loader

print("torchrl", version("torchrl"), "tensordict", version("tensordict"), "torch", version("torch"))
name, length, rows = "main/walker_walk/expert/84px", 4, 8  # two episodes of four rows
file = Path(sys.argv[1]) / "0_shard.hdf5"
first = np.arange(rows) % length == 0
with h5py.File(file, "w") as out:
    out["observation"] = np.arange(rows, dtype=np.uint8)[:, None, None, None] * np.ones((1, 3, 8, 8), np.uint8)
    led_here = np.where(first, 0, np.arange(rows))  # action t leads from frame t-1 to frame t, and earns 10 t
    out["action"] = led_here[:, None] * np.ones((1, 2), np.float32)
    out["reward"] = led_here * 10.0
    out["discount"] = np.ones(rows)
    out["step_type"] = np.where(first, 0, np.where(np.arange(rows) % length == length - 1, 2, 1))
Loader._parse_datasets = classmethod(lambda cls: {Path("vd4rl") / name: [Path("vd4rl") / name / file.name]})
Loader._hf_hub_download = classmethod(lambda cls, folder, filename, tmpdir: str(file))
data = Loader(name, batch_size=4, root=sys.argv[1] + "/root", totensor=False)[:]
pairs = []
for row in data:
    pairs.append((int(row["pixels"].max()), float(row["action"][0]), int(row["next", "pixels"].max())))
    print("frame {} action {} next frame {}".format(*pairs[-1]), "reward", float(row["next", "reward"]))
print("keys of the next step:", sorted(map(str, data["next"].keys())))
assert pairs[1] == (1, 1.0, 2), "the action that led to frame 1 is no longer paired with the step to frame 2"
assert pairs[3] == (3, 3.0, 4) and "done" not in data["next"].keys(), "episodes are kept apart"
PY
