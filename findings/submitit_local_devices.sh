#!/usr/bin/env bash
# One would guess: submitit's LocalExecutor runs jobs in the environment that they were submitted from, GPUs included.
# What happens: it sets CUDA_VISIBLE_DEVICES itself: to nothing unless gpus_per_node is given, else to 0, 1, ... for
# every job alike, whatever the submitting shell allowed. No GPU is needed to see it.
# For this field: a sweep tried locally trains on the CPU without a word, or puts all jobs on GPU 0, even on a shared
# machine where the scheduler had given GPU 3.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet submitit==1.5.4
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import sys
from importlib.metadata import version

import submitit


def devices():
    import os

    return os.environ.get("CUDA_VISIBLE_DEVICES")


print("submitit", version("submitit"))
seen = {}
for allowed, asked in ((None, None), ("3", None), ("3", 1)):
    os.environ.pop("CUDA_VISIBLE_DEVICES", None)
    if allowed:
        os.environ["CUDA_VISIBLE_DEVICES"] = allowed
    executor = submitit.LocalExecutor(folder=sys.argv[1] + "/jobs")
    executor.update_parameters(**({"gpus_per_node": asked} if asked else {}))
    jobs = [executor.submit(devices) for _ in range(2)]
    seen[allowed, asked] = [job.result() for job in jobs]
    print(f"submitted with {allowed!r}, gpus_per_node {asked}: two jobs see {seen[allowed, asked]}")
assert seen[None, None] == seen["3", None] == ["", ""] and seen["3", 1] == ["0", "0"], "devices are set otherwise"
PY
