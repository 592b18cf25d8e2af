#!/usr/bin/env bash
# One would guess: torchrl's `SliceSampler` draws windows uniformly from a dataset.
# What happens: it draws an episode first, each with equal probability, then a window in it. Of two episodes with 20 and
# 980 rows, half of all windows come from the short one: each of its rows is drawn 50 times as often.
# For this field: where failure ends an episode, short episodes are the failures, so a sequence model is trained mostly
# on them; compare with a loader that draws rows (d3rlpy, DrQ-v2) and the losses differ for no visible reason.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" torchrl==0.14.1 numpy==2.4.6
"$tmp/venv/bin/python" -W ignore - 2> "$tmp/log" << 'PY' || { cat "$tmp/log"; exit 1; }
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

print("torchrl", version("torchrl"))
torch.manual_seed(0)
rows = torch.tensor([20, 980])
episode = torch.repeat_interleave(torch.arange(2), rows)
sampler = SliceSampler(slice_len=10, traj_key="episode")
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), sampler=sampler, batch_size=100_000)
buffer.extend(TensorDict({"episode": episode}, [1000]))
drawn = buffer.sample()["episode"].view(-1, 10)
share = (drawn[:, 0] == 0).double().mean().item()
print(f"windows of 10 rows from episodes of {rows.tolist()} rows: {share:.1%} are from the short one")
print(f"it has {rows[0] / rows.sum():.1%} of the rows and {11 / (11 + 971):.1%} of the windows")
assert 0.45 < share < 0.55, "windows are uniform"
PY
