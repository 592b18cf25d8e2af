#!/usr/bin/env bash
# One would guess: h5py.File(path, "r") cannot change a file, and either opens read-only or fails.
# What happens: if the same process has the file open for writing (a writer in another module, a forgotten handle), "r"
# gives that open file: its mode is "r+" and assignments through it reach the disk. The other order, "r" first, raises
# an OSError whose errno is None. Another process gets errno 11 instead.
# For this field: a loader that trusts "r" to protect a data set does not; check `file.mode`.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet h5py==3.16.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import subprocess
import sys

import h5py

print("h5py", h5py.__version__, "HDF5", h5py.version.hdf5_version)
path = sys.argv[1] + "/set.hdf5"
writer = h5py.File(path, "w")
writer["action"] = [1, 2, 3]
writer.flush()
reader = h5py.File(path, "r")
mode = reader.mode
reader["action"][0] = 99
other = subprocess.run([sys.executable, "-c", f"import h5py; h5py.File({path!r}, 'r')"], capture_output=True, text=True)
reader.close()
writer.close()
with h5py.File(path, "r") as file:
    stored = file["action"][:].tolist()
    try:
        h5py.File(path, "r+")
    except OSError as error:
        second = error.errno, str(error)
print("asked for 'r', got mode", repr(mode), "and after an assignment the file holds", stored)
print("another process meanwhile:", other.stderr.strip().splitlines()[-1])
print("'r+' while 'r' is open in the same process:", second)
assert mode == "r+" and stored == [99, 2, 3], "'r' protects the file"
assert "errno = 11" in other.stderr and second[0] is None
PY
