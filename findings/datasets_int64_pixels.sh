#!/usr/bin/env bash
# One would guess: a column declared `uint8` comes back as uint8, and one declared `float64` as float64, when `datasets`
# returns tensors.
# What happens: `with_format("torch")` and `with_format("numpy")` widen all integers to int64 and narrow all floats to
# float32. Pixels of `Array3D(..., "uint8")` take eight times the memory; float64 simulator states and rewards lose half
# of their digits, although the files hold them. Only the `Image` feature keeps uint8. A dtype can be passed
# (`with_format("numpy", dtype=...)`), but one for all columns.
# For this field: stored states no longer replay an episode exactly, and code that scales pixels only if they are uint8
# trains on 0 to 255.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet datasets==5.2.0 pyarrow==26.0.1 "torch>=2.11,<2.14" numpy==2.4.6
HF_HOME="$tmp" HF_HUB_OFFLINE=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
import datasets
import numpy as np
import torch
from datasets import Array3D, Dataset, Features, Sequence, Value

print("datasets", datasets.__version__, "torch", torch.__version__)
draw = np.random.default_rng(0)
state = draw.standard_normal((4, 24))
content = {"pixels": list(draw.integers(0, 256, (4, 9, 84, 84), np.uint8)), "state": list(state), "reward": state[:, 0]}
kinds = Features(pixels=Array3D((9, 84, 84), "uint8"), state=Sequence(Value("float64")), reward=Value("float64"))
data = Dataset.from_dict(content, features=kinds)
for kind in ("numpy", "torch"):
    rows = data.with_format(kind)[:]
    found = {name: str(column.dtype).removeprefix("torch.") for name, column in rows.items()}
    error = float(np.abs(np.asarray(rows["state"], np.float64) - state).max())
    print(f"{kind}: {found}, pixels {rows['pixels'].nbytes / 1e6:.1f} of 0.3 MB, states off by up to {error:.0e}")
    assert found == {"pixels": "int64", "state": "float32", "reward": "float32"}, "dtypes are kept"
    assert error > 0
stored = data.with_format("arrow")[:]
print("stored:", {name: str(stored.schema.field(name).type)[:60] for name in ("state", "reward")})
assert np.array_equal(np.array(stored["state"].to_pylist()), state)
PY
