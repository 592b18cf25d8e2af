#!/usr/bin/env bash
# One would guess: a zarr store that lost a file (an upload cut short, a folder copied in part) raises an error when
# read.
# What happens: a chunk without a file is by definition full of the fill value: black pictures, zero actions, no error.
# And one cannot tell by counting files, since chunks that are all zero are not written in the first place.
# For this field: robot learning data is shared as zarr folders of thousands of files; keep a manifest and compare.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet zarr==3.1.6 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys

import numpy as np
import zarr

print("zarr", zarr.__version__)
os.chdir(sys.argv[1])


def files(store):
    return sorted(os.path.relpath(os.path.join(at, name)) for at, _, names in os.walk(store) for name in names)


pictures = zarr.open_array("whole.zarr", mode="w", shape=(8, 4, 4), chunks=(2, 4, 4), dtype="u1")
pictures[:] = 200
print("stored:", files("whole.zarr"))
os.remove("whole.zarr/c/2/0/0")
means = zarr.open_array("whole.zarr", mode="r")[:].mean((1, 2)).tolist()
print("mean of each picture, one file gone:", means)
dark = zarr.open_array("dark.zarr", mode="w", shape=(8, 4, 4), chunks=(2, 4, 4), dtype="u1")
dark[:] = np.repeat(np.uint8([0, 0, 1, 1, 1, 1, 1, 1]), 16).reshape(8, 4, 4)
print("a set that begins with two black pictures:", files("dark.zarr"))
assert means == [200, 200, 200, 200, 0, 0, 200, 200], "a missing chunk is told"
assert len(files("dark.zarr")) == 4, "chunks of zeros are written"
PY
