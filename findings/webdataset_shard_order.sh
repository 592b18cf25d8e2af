#!/usr/bin/env bash
# One would guess: `WebDataset(urls, shardshuffle=100)` draws another order of shards for each epoch.
# What happens: it draws a seed once and restarts from it, so all epochs read the shards in one order. With
# `detshuffle=True` it counts epochs, but in the object that iterates: a DataLoader's workers are new copies in each
# epoch and count from 0 again, unless `persistent_workers=True`.
# For this field: a shard holds whole episodes, and `.shuffle(n)` mixes only n neighbouring rows, so batches mix the
# same few episodes in each epoch.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" webdataset==1.0.2 numpy==2.4.6
OMP_NUM_THREADS=1 "$tmp/venv/bin/python" -W ignore - "$tmp" << 'PY'
import sys

import torch
import webdataset
from torch.utils.data import DataLoader

print("webdataset", webdataset.__version__, "torch", torch.__version__)
SHARDS, EPOCHS = 12, 3
urls = [f"{sys.argv[1]}/{shard:02}.tar" for shard in range(SHARDS)]
for shard, url in enumerate(urls):
    with webdataset.TarWriter(url) as writer:
        writer.write({"__key__": f"{shard:02}", "shard.cls": shard})


def dataset(**options):
    return webdataset.WebDataset(urls, shardshuffle=SHARDS, **options).decode().map(lambda sample: sample["shard.cls"])


def loader(**options):
    return DataLoader(dataset(detshuffle=True), batch_size=None, num_workers=2, **options)


orders = {}
for name, source in (
    ("shardshuffle", dataset()),
    ("detshuffle", dataset(detshuffle=True)),
    ("detshuffle, two workers", loader()),
    ("detshuffle, two persistent workers", loader(persistent_workers=True)),
):
    epochs = [[int(shard) for shard in source] for _ in range(EPOCHS)]
    orders[name] = len({tuple(epoch) for epoch in epochs})
    print(f"{name}: {orders[name]} orders in {EPOCHS} epochs")
    for epoch in epochs:
        print("  ", *epoch)
assert list(orders.values()) == [1, EPOCHS, 1, EPOCHS], "the orders of shards changed"
PY
