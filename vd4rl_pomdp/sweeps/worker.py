"""The process that does one job of a sweep: `python -m vd4rl_pomdp.sweeps.worker JSON`.

It ends with the process that started it, and its exit code says why it ended. A code that is none of those comes from a
signal that cannot be answered, or from a defect, whose traceback is in the log. A cluster may signal all processes of a
task at once, and the task's own then asks its jobs to end: the first SIGTERM counts, further ones change nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
from types import FrameType

from vd4rl_pomdp.sweeps.work import INTERRUPTED, code_of

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Do the job that the command line names."""
    told = json.loads(sys.argv[1])
    if sys.platform == "linux":
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # Slurm's warning, which its task answers
        _end_with(told["parent"])
        if told["cores"]:
            os.sched_setaffinity(0, told["cores"])
    signal.signal(signal.SIGTERM, _end_interrupted)  # importing what follows takes a while
    words = told["words"]
    sys.argv = ["vd4rl-pomdp", *words]  # what a run records as its command
    from vd4rl_pomdp.cli import End, run_to_end
    from vd4rl_pomdp.core.errors import UserError
    from vd4rl_pomdp.core.registry import changed_since
    from vd4rl_pomdp.sweeps.own_file import load

    load(told["own_file"])
    if changed := changed_since(told["sources"]):
        line = (
            f"the file of {changed[0]} has changed since the sweep was started: start the sweep again, or put it back"
        )
        end = End(2, UserError.cause, f"error: {line}")
    else:
        end = run_to_end(words, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # a full disk
        print(end.line or end.cause, file=sys.stderr, flush=True)
    sys.exit(code_of(end.cause))


def _end_interrupted(number: int, frame: FrameType | None) -> None:
    """End before the job has begun."""
    os._exit(code_of(INTERRUPTED))


def _end_with(parent: int) -> None:
    """Have the system send this process SIGTERM when its parent is gone, however it went."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it went before the line above
        sys.exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    main()
