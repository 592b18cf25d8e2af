#!/usr/bin/env bash
# One would guess: the workers of a DataLoader augment independently, and each epoch anew, as with torch's own random
# numbers.
# What happens: albumentations' last release draws from a generator inside the pipeline. Every worker gets a copy of it
# in the same state, at the start of every epoch: two workers draw the same crops, and epoch two repeats epoch one, with
# `seed=None`, too. Without workers, or with albumentationsx 2.5.1, all draws differ.
# For this field: random shifts are what keeps visual RL from overfitting; here each image keeps one shift for good.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" albumentations==2.0.8 opencv-python-headless==4.13.0.92 \
    numpy==2.4.6
NO_ALBUMENTATIONS_UPDATE=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
import albumentations
import numpy as np
from torch.utils.data import DataLoader

print("albumentations", albumentations.__version__)
image = np.arange(92 * 92, dtype=np.float32).reshape(92, 92, 1)  # each pixel tells its place


class Shifts:
    def __init__(self):
        self.crop = albumentations.Compose([albumentations.RandomCrop(84, 84)])

    def __len__(self):
        return 8

    def __getitem__(self, index):
        return int(self.crop(image=image)["image"][0, 0, 0])


def epochs(workers):
    start = "fork" if workers else None
    loader = DataLoader(Shifts(), batch_size=1, num_workers=workers, multiprocessing_context=start)
    return [[divmod(int(shift), 92) for shift in loader] for _ in range(2)]


here, apart = epochs(0), epochs(2)
for name, found in (("no worker", here), ("two workers", apart)):
    print(f"{name}, seed=None:\n  epoch 1 {found[0]}\n  epoch 2 {found[1]}")
assert here[0] != here[1]
assert apart[0] == apart[1], "epochs differ"
assert apart[0][0::2] == apart[0][1::2], "workers differ"
PY
