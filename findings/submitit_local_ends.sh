#!/usr/bin/env bash
# One would guess: submitit's local jobs end as Slurm's do: FAILED or TIMEOUT when they died, and a task with a
# `checkpoint` method is asked for it before its time limit, so a local trial proves that requeueing works.
# What happens: a job whose process dies and one that is ended by its limit are both FINISHED (only `result()` raises),
# and at the limit the function gets a KeyboardInterrupt: `checkpoint` is never called, nothing is requeued.
# For this field: a sweep that waits for "FINISHED" counts dead seeds as done, and resuming stays untested until the
# cluster.
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

print("submitit", version("submitit"))


def dies():
    import os

    os._exit(3)


class Trains:
    def __call__(self, mark):
        import time

        for _ in range(600):
            time.sleep(0.1)

    def checkpoint(self, mark):
        open(mark, "w").close()
        return submitit.helpers.DelayedSubmission(self, mark)


mark = sys.argv[1] + "/checkpoint_was_called"
executor = submitit.LocalExecutor(folder=sys.argv[1] + "/jobs")
executor.update_parameters(timeout_min=0.05)
for name, job in (("dies", executor.submit(dies)), ("is too slow", executor.submit(Trains(), mark))):
    try:
        job.result()
        raised = "nothing"
    except BaseException as error:
        raised = type(error).__name__
    last = (job.stderr() or "-").split()[-1]
    print(f"a job that {name}: state {job.state}, result() raises {raised}; stderr ends: {last}")
    assert job.state == "FINISHED" and raised == "UncompletedJobError", "states tell"
print("checkpoint was called:", os.path.exists(mark))
assert "KeyboardInterrupt" in job.stderr() and not os.path.exists(mark), "checkpoint is called"
PY
