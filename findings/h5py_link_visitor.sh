#!/usr/bin/env bash
# One would guess: an exception in a visitor of an HDF5 file reaches the caller unchanged.
# What happens: so it does from `Group.visit` and `visititems`. From the low-level `links.visit`, the only one that meets
# soft and external links without opening what they name, it arrives as a SystemError about a lock; the exception itself
# is only its cause.
# For this field: a guard that walks the links of a downloaded data set and raises, or meets a missing object, is not
# caught by `except (KeyError, ValueError)`; collect the names first and check them afterwards.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet h5py==3.16.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import sys

import h5py


def refuse(name, *_):
    raise ValueError("refused")


print("h5py", h5py.__version__, "HDF5", h5py.version.hdf5_version)
path = sys.argv[1] + "/set.hdf5"
with h5py.File(path, "w") as file:
    file["action"] = [1, 2, 3]
    file["link"] = h5py.SoftLink("/action")
caught, met = {}, {}
with h5py.File(path) as file:
    for title, visit in {"visit": file.visit, "visititems": file.visititems, "links.visit": file.id.links.visit}.items():
        names = []
        visit(lambda name, *_: names.append(name))
        met[title] = len(names)
        try:
            visit(refuse)
        except Exception as error:
            caught[title] = type(error).__name__, type(error.__cause__).__name__
for title, names in caught.items():
    print(f"{title}: met {met[title]} names; a ValueError arrives as {names[0]}, caused by {names[1]}")
assert met == {"visit": 1, "visititems": 1, "links.visit": 2}
assert caught["visit"] == caught["visititems"] == ("ValueError", "NoneType")
assert caught["links.visit"] == ("SystemError", "ValueError"), "the exception arrives as it is"
PY
