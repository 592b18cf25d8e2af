#!/usr/bin/env bash
# One would guess: Pillow's BOX and torch's `adaptive_avg_pool2d` and `interpolate(mode="area")` average the area that
# a new pixel covers. From 120 to 84 each new pixel covers 1.43 old ones, so every old pixel should weigh 84/120 = 0.7
# in total.
# What happens: BOX takes an old pixel whole or not at all; torch averages whole bins that overlap. Both are exact for
# whole ratios only. Totals of an old pixel run from 0.5 to 1 (Pillow) and from 0.33 to 1 (torch).
# For this field: thin objects brighten, fade or double with their position, and two pipelines show two different
# pictures.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" pillow==13.0.0 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import numpy as np
import PIL
import torch
import torch.nn.functional as F
from PIL import Image

print("Pillow", PIL.__version__, "torch", torch.__version__)


def weights(old, new):  # (new, old) each: what each old pixel gives to each new one
    edges = np.arange(new + 1) * old / new
    j = np.arange(old)
    area = (np.minimum(edges[1:, None], j + 1) - np.maximum(edges[:-1, None], j)).clip(0) * new / old
    one = np.eye(old, dtype=np.float32)
    box = [np.asarray(Image.fromarray(row[None]).resize((new, 1), Image.Resampling.BOX))[0] for row in one]
    rows = torch.from_numpy(one)[:, None, None]
    pool = F.adaptive_avg_pool2d(rows, (1, new))[:, 0, 0].T.numpy()
    mode = F.interpolate(rows, size=(1, new), mode="area")[:, 0, 0].T.numpy()
    return {"area": area, "Pillow BOX": np.stack(box, 1), "adaptive_avg_pool2d": pool, "interpolate area": mode}


for old, new in ((168, 84), (120, 84), (480, 84)):
    found = weights(old, new)
    for name, w in found.items():
        stripes = np.zeros(old)  # every third old pixel is white
        stripes[::3] = 255
        off = np.abs(w @ stripes - found["area"] @ stripes).max()
        total = w.sum(0)
        line = f"{old} -> {new} {name:20} total of an old pixel {total.min():.2f} to {total.max():.2f}"
        print(line, f"off by up to {off:.0f} of 255")
        if name != "area":
            assert (off < 0.01) if old == 168 else (off > 5), "areas are averaged otherwise"
PY
