#!/usr/bin/env bash
# One would guess: Minari's storages differ in speed, not in what they give back.
# What happens: of an episode of more than 32,767 steps Arrow and Parquet give the first 32,768 rows, without its end;
# iterating on, the second episode's number comes with a later piece of the first. `total_steps` counts all. HDF5 does
# neither. Nothing is raised.
# For this field: long recordings lose most of their data, and episodes are mixed up. Compare each length with what the
# episode's metadata say, or store as HDF5.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "minari[hdf5,arrow]==0.5.4" \
    gymnasium==1.4.0 numpy==2.4.6 h5py==3.16.0 pillow==13.0.0 pyarrow==26.0.1
"$tmp/venv/bin/python" -W ignore - "$tmp" << 'PY'
import os
import sys

os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium
import minari
import numpy as np
import pyarrow
from minari.data_collector import EpisodeBuffer

print("minari", minari.__version__, "pyarrow", pyarrow.__version__)
space, steps = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64), 200_000


def episode(number):
    """The observation tells the episode and the step."""
    return EpisodeBuffer(
        observations=number * 1e6 + np.arange(steps + 1.0)[:, None],
        actions=np.zeros((steps, 1)),
        rewards=np.ones(steps),
        terminations=np.zeros(steps, bool),
        truncations=np.arange(steps) == steps - 1,
    )


seen = {}
for storage in ("hdf5", "arrow", "parquet"):
    dataset = minari.create_dataset_from_buffers(
        f"{storage}-v0", [episode(0), episode(1)], observation_space=space, action_space=space, data_format=storage
    )
    seen[storage] = [(len(one), float(one.observations[0, 0]), bool(one.truncations[-1])) for one in dataset]
    print(storage, dataset.total_steps, "steps; of each episode steps, first observation, end:", seen[storage])
assert seen["hdf5"] == [(steps, 0, True), (steps, 1e6, True)]
for storage in ("arrow", "parquet"):
    assert all(length < steps and not end for length, _, end in seen[storage]), "whole episodes come back"
    assert 0 < seen[storage][1][1] < 1e6, "the second episode is the second"
PY
