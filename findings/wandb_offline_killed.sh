#!/usr/bin/env bash
# One would guess: a row that wandb has logged offline is on disk a moment later.
# What happens: its service, a process of its own, keeps rows in memory until a block of 32 KiB is full or some 15
# seconds have passed. At two rows a second the file lags by ten rows and more; if run and service are killed then, as
# a scheduler kills a job, those rows are gone.
# For this field: seeds are killed all the time, and the last rows are lost, also for `wandb sync`. Keep a file of
# metrics of your own, and log again from it on resuming.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet wandb==0.31.0
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import glob
import os
import re
import signal
import subprocess
import sys
import time

log = """
import sys, time, wandb
settings = wandb.Settings(console="off", silent=True)
run = wandb.init(project="p", mode="offline", dir=sys.argv[1], settings=settings)
for i in range(240):
    run.log({"loss": i * 0.5, "mark": f"row{i:05d}"}, step=i)
    print(wandb.__version__, flush=True)
    time.sleep(0.5)
"""


def rows():
    [file] = glob.glob(sys.argv[1] + "/wandb/offline*/*.wandb")
    with open(file, "rb") as stored:
        return len(set(re.findall(rb"row\d{5}", stored.read())))


run = subprocess.Popen([sys.executable, "-c", log, sys.argv[1]], stdout=subprocess.PIPE, text=True)
logged, lag, version = 0, 0, ""
for line in run.stdout:
    logged, version = logged + 1, line.strip()
    lag = logged - rows()
    if logged > 40 and lag > 10:
        break
for path in glob.glob(f"/proc/{run.pid}/task/*/children"):
    with open(path) as service:
        for pid in service.read().split():
            os.kill(int(pid), signal.SIGKILL)
run.kill()
run.wait()
time.sleep(5)
print(f"wandb {version}: {logged} rows logged, run and service killed: {rows()} in the file, {logged - rows()} lost")
assert logged < 240 and logged - rows() > 8, "rows are written at once"
PY
