#!/usr/bin/env bash
# One would guess: with `OMP_WAIT_POLICY=PASSIVE` torch's waiting threads sleep, so two programs that share two cores
# each get about half of the speed.
# What happens: not where convolutions are differentiated. There oneDNN's threads wait for each other by spinning,
# outside OpenMP. Two trainings of a small convolutional network with two threads each take many times as long as one of
# them; with one thread each they hardly disturb each other.
# For this field: two seeds in two terminals of a laptop. One thread per training is the cure (`OMP_NUM_THREADS=1`).
# (Linux, two cores or more; ratios vary by machine.)
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" numpy==2.4.6
"$tmp/venv/bin/python" - << 'PY'
import os
import subprocess
import sys

import torch

train = """
import time, torch
from torch.nn import Conv2d, ReLU
net = torch.nn.Sequential(Conv2d(9, 32, 8, 4), ReLU(), Conv2d(32, 64, 4, 2), ReLU(), Conv2d(64, 64, 3), ReLU())
pictures = torch.rand(256, 9, 84, 84)

def step():
    with torch.autocast("cpu", torch.bfloat16):
        loss = net(pictures).float().mean()
    loss.backward()

step()
print("ready", flush=True)
input()
count, start = 0, time.time()
while time.time() < start + 8:
    step()
    count += 1
print((time.time() - start) / count * 1000)
"""
cores = sorted(os.sched_getaffinity(0))[:2]
if len(cores) < 2:
    print("skipped, nothing seen: needs two cores")
    sys.exit(77)
os.sched_setaffinity(0, cores)
print("torch", torch.__version__)


def milliseconds(programs, threads):
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": str(threads)}
    environment.pop("GOMP_SPINCOUNT", None)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    running = [subprocess.Popen([sys.executable, "-c", train], **pipes) for _ in range(programs)]
    for each in running:
        assert each.stdout.readline() == "ready\n"
    for each in running:
        each.stdin.write("\n")
        each.stdin.flush()
    return max(float(each.communicate()[0]) for each in running)


(one, two), (single, singles) = ([milliseconds(count, threads) for count in (1, 2)] for threads in (2, 1))
print(f"two threads each: {one:.0f} ms a step alone, {two:.0f} ms beside a second ({two / one:.1f} times)")
print(f"one thread each: {single:.0f} ms alone, {singles:.0f} ms beside a second ({singles / single:.1f} times)")
assert two > 3 * one, "two threads each share the cores better than measured"
assert singles < 2 * single, "one thread each disturb each other"
PY
