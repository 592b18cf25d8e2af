#!/usr/bin/env bash
# One would guess: a row that wandb has logged offline is on disk a moment later.
# What happens: rows gather in memory until a block of 32 KiB is full or the run is finished. A process killed five
# seconds after 30 rows leaves a file without any of them; of 400 rows it keeps whole blocks only. A finished run has
# all.
# For this field: seeds are killed by schedulers and spot machines all the time, and metrics come slowly: the last rows
# are gone for good, also for `wandb sync`. Keep a file of metrics of your own, and log again from it on resuming.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet wandb==0.31.0
"$tmp/venv/bin/python" - "$tmp" << 'PY'
import glob
import os
import re
import subprocess
import sys
import time

log = """
import sys, time, wandb
settings = wandb.Settings(console="off", silent=True)
run = wandb.init(project="p", mode="offline", dir=sys.argv[1], settings=settings)
for i in range(int(sys.argv[2])):
    run.log({"loss": i * 0.5, "mark": f"row{i:05d}"}, step=i)
run.log({"end": 1}, step=i + 1)
print(wandb.__version__, flush=True)
if sys.argv[3] == "finish":
    run.finish()
else:
    time.sleep(60)
"""
kept = {}
for rows, end in ((30, "finish"), (30, "kill"), (400, "kill")):
    folder = f"{sys.argv[1]}/{rows}{end}"
    os.mkdir(folder)
    run = subprocess.Popen([sys.executable, "-c", log, folder, str(rows), end], stdout=subprocess.PIPE, text=True)
    version = run.stdout.readline().strip()
    if end == "kill":
        time.sleep(5)
        run.kill()
    run.wait()
    time.sleep(5)  # wandb's own service ends after the run
    [file] = glob.glob(folder + "/wandb/offline*/*.wandb")
    with open(file, "rb") as stored:
        kept[rows, end] = len(set(re.findall(rb"row\d{5}", stored.read())))
    print(f"wandb {version}: {rows} rows logged, then {end}: {kept[rows, end]} in the file")
assert kept[30, "finish"] == 30 and kept[30, "kill"] == 0 and 100 < kept[400, "kill"] < 400, "rows are kept otherwise"
PY
