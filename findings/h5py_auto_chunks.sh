#!/usr/bin/env bash
# One would guess: a compressed HDF5 data set of pictures is stored a few pictures per chunk, so reading one is cheap.
# What happens: without `chunks=`, h5py halves every axis in turn: chunks of 1566 rows by one channel by 6 by 11 pixels
# for 25,050 pictures of 84x84. One picture lies in 336 chunks, 34.7 MB to decompress for 21 kB, more than the chunk
# cache holds.
# For this field: V-D4RL-like files made by h5py read well from end to end and a thousand times too slowly at random.
# Give `chunks=(1, 3, 84, 84)`, or decode the set once.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet h5py==3.16.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import math
import sys

import h5py
import numpy as np

print("h5py", h5py.__version__, "HDF5", h5py.version.hdf5_version)
with h5py.File(sys.argv[1] + "/set.hdf5", "w") as file:
    for name, chunks in (("as h5py guesses", None), ("chunks=(1, 3, 84, 84)", (1, 3, 84, 84))):
        data = file.create_dataset(name, (25050, 3, 84, 84), np.uint8, compression="gzip", chunks=chunks)
        touched = math.prod(math.ceil(size / chunk) for size, chunk in zip(data.shape[1:], data.chunks[1:]))
        read = touched * math.prod(data.chunks)
        times = read / (3 * 84 * 84)
        print(f"{name}: {data.chunks}, one picture: {touched} chunks, {read:,} bytes, {times:,.0f} times its size")
        assert times > 500 if chunks is None else times == 1, "h5py guesses other chunks"
    cache = file.id.get_access_plist().get_cache()[2]
    print(f"chunk cache: {cache:,} bytes")
    assert cache < 34_000_000, "the cache holds a picture's chunks"
PY
