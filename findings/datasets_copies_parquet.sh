#!/usr/bin/env bash
# One would guess: `Dataset.from_parquet` of files on the same disk maps them into memory where they are.
# What happens: everything, pictures included, is written a second time as Arrow into ~/.cache/huggingface first, and
# again under a new name whenever a file's time has changed. Nothing removes the old copies.
# For this field: LeRobotDataset(root=...) loads this way, so a set of pictures takes twice its size, and each edit of
# it one size more. Set HF_DATASETS_CACHE to a disk with room, and empty it by hand.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet datasets==5.2.0 pyarrow==26.0.1 pillow==13.0.0
HF_HOME="$tmp/cache" HF_HUB_OFFLINE=1 "$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys
from pathlib import Path

import datasets
import pyarrow
import pyarrow.parquet

datasets.disable_progress_bars()
print("datasets", datasets.__version__, "pyarrow", pyarrow.__version__)
pictures = [{"bytes": os.urandom(10_000), "path": None} for _ in range(2000)]
path = Path(sys.argv[1]) / "set.parquet"
pyarrow.parquet.write_table(pyarrow.table({"picture": pictures, "row": range(2000)}), path)


def cached():
    return sum(file.stat().st_size for file in (Path(sys.argv[1]) / "cache").rglob("*") if file.is_file()) / 1e6


sizes = []
for what in ("loaded", "loaded again", "touched and loaded"):
    if what.startswith("touched"):
        os.utime(path, (1, 1))
    loaded = datasets.Dataset.from_parquet([str(path)])
    sizes.append(cached())
    print(f"{what}: the file has {path.stat().st_size / 1e6:.0f} MB, the cache {sizes[-1]:.0f} MB")
assert len(loaded) == 2000
assert sizes[0] > 15 and abs(sizes[1] - sizes[0]) < 1 and sizes[2] > 1.9 * sizes[0], "files are read where they are"
PY
