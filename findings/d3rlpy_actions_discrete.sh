#!/usr/bin/env bash
# One would guess: d3rlpy takes float32 actions of a continuous task for continuous.
# What happens: the kind is guessed from the values of the first episode: if they are whole numbers, the set is
# DISCRETE, with as many actions as its largest value plus one, whatever dtype, shape and later episodes. Bang-bang
# actions of two joints in {-1, 0, 1} become two actions; an episode of zero actions at the head of a set is enough.
# For this field: experts that saturate at +-1 are taken for Atari. Pass action_space. Also, an episode that ends by
# `timeouts`, as dm_control's do, gives one transition less than rows.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" d3rlpy==2.8.1 numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import warnings

warnings.simplefilter("ignore")
import logging

import d3rlpy
import numpy as np
import structlog

structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
print("d3rlpy", d3rlpy.__version__)
rows, draw = 10, np.random.default_rng(0)
pictures, rewards, ends = np.zeros((rows, 3, 8, 8), np.uint8), np.zeros(rows, np.float32), np.arange(rows) % 5 == 4
actions = draw.integers(-1, 2, (rows, 2)).astype(np.float32)
actions[0] = 1
late, early = actions.copy(), actions.copy()
late[5:] = 0.5  # all of the second episode
early[3, 0] = 0.5
found = {}
for name, a in (("whole", actions), ("whole in the first episode", late), ("one fraction in the first", early)):
    info = d3rlpy.dataset.MDPDataset(pictures, a, rewards, np.zeros(rows), ends.astype(float)).dataset_info
    found[name] = info.action_space.name, int(info.action_size)
    print(f"float32 actions (10, 2), {name}:", *found[name])
counts = []
for terminals, timeouts in ((ends, 0 * ends), (0 * ends, ends)):
    data = d3rlpy.dataset.MDPDataset(pictures, early, rewards, terminals.astype(float), timeouts.astype(float))
    counts.append([episode.transition_count for episode in data.episodes])
print("episodes of five rows, transitions if terminal:", counts[0], "if cut by time:", counts[1])
assert list(found.values()) == [("DISCRETE", 2)] * 2 + [("CONTINUOUS", 2)], "guessed otherwise"
assert counts == [[5, 5], [4, 4]]
PY
