#!/usr/bin/env bash
# One would guess: of two cores, one busy with something else leaves torch at least half of its speed.
# What happens: torch's OpenMP threads wait for each other by spinning. With two threads and a second program on one of
# the cores, each small layer waits until the scheduler has gone round: ten and more times slower than waiting
# passively.
# For this field: networks of 256 units have many small layers; two seeds side by side, or one beside a simulator,
# crawl. `OMP_WAIT_POLICY=PASSIVE` before torch is loaded, or one thread. (Linux, two cores or more; ratios vary by
# machine.)
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import os
import subprocess
import sys

import torch

train = """
import time, torch
torch.set_num_threads(2)
L, R = torch.nn.Linear, torch.nn.ReLU
net, x = torch.nn.Sequential(L(64, 256), R(), L(256, 256), R(), L(256, 6)), torch.randn(256, 64)
count = 0
while count < 10 or time.time() < end:
    if count == 9:
        start = time.time(); end = start + 5
    net(x).square().mean().backward()
    count += 1
print((time.time() - start) / (count - 9) * 1000)
"""
cores = sorted(os.sched_getaffinity(0))[:2]
if len(cores) < 2:
    print("skipped, nothing seen: needs two cores")
    sys.exit(77)
os.sched_setaffinity(0, cores)
print("torch", torch.__version__)


def milliseconds(policy):
    done = subprocess.run(
        [sys.executable, "-c", train],
        env={**os.environ, "OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": policy} if policy else without,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)


without = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
try:
    os.sched_setaffinity(busy.pid, cores[1:])
    default, passive = milliseconds(None), milliseconds("PASSIVE")
finally:
    busy.kill()
    busy.wait()
print(f"beside a busy program: {default:.1f} ms by default, {passive:.1f} ms with OMP_WAIT_POLICY=PASSIVE")
assert default > 3 * passive, "spinning costs less than measured"
PY
