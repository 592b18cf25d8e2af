#!/usr/bin/env bash
# One would guess: a flattened dm_control observation has the same order in every library, that of the dictionary, or
# the order that one asks for.
# What happens: dm_control concatenates orientations, height, velocity. Through shimmy, Gymnasium's FlattenObservation
# sorts the names: height comes first. torchrl's CatTensors sorts its `in_keys`, too, even when they are listed in
# dm_control's order; `sort=False` keeps it.
# For this field: all three vectors of walker have shape (24,), so a policy or a dataset of one loads in the other and
# reads a height as an orientation.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchrl==0.14.1 shimmy==2.0.1 gymnasium==1.4.0 \
    dm-control==1.0.44 mujoco==3.11.0 imageio==2.38.1 numpy==2.4.6
MUJOCO_GL=disabled "$tmp/venv/bin/python" -W ignore - << 'PY'
from importlib.metadata import version

import numpy as np
import torch
from dm_control import suite
from gymnasium.wrappers import FlattenObservation
from shimmy import DmControlCompatibilityV0
from tensordict import TensorDict
from torchrl.envs import CatTensors

print(*(f"{name} {version(name)}" for name in ("dm-control", "shimmy", "gymnasium", "torchrl")))


def load(**kwargs):
    return suite.load("walker", "walk", task_kwargs={"random": 0}, environment_kwargs=kwargs)


parts = load().reset().observation
names = list(parts)
flat = {"dm_control": load(flat_observation=True).reset().observation["observations"]}
flat["shimmy, gymnasium"] = FlattenObservation(DmControlCompatibilityV0(load())).reset()[0]
tensors = TensorDict({name: torch.tensor(np.atleast_1d(parts[name])) for name in names})
for sort in (True, False):
    asked = {} if sort else {"sort": False}
    flat[f"torchrl {asked}"] = CatTensors(in_keys=names, out_key="flat", **asked)(tensors.clone())["flat"].numpy()
places = {name: int(np.flatnonzero(vector == parts["height"])[0]) for name, vector in flat.items()}
for name, vector in flat.items():
    print(f"{name:20} shape {vector.shape}, height is element {places[name]}")
assert list(places.values()) == [14, 0, 0, 14], "the orders agree"
assert len({vector.shape for vector in flat.values()}) == 1
PY
