"""Sweeps without training: a program in place of `vd4rl-pomdp` follows each job's script."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from vd4rl_pomdp.runs.run import recipe
from vd4rl_pomdp.sweeps.folder import Plan, SweepFolder
from vd4rl_pomdp.sweeps.plan import Job

RECORD = {"stage": "pretrain", "config": {"seed": 0}, "inputs": {"data": "its set"}}
PROGRAM = """
import json, os, sys, time
from contextlib import ExitStack
from pathlib import Path
from vd4rl_pomdp.runs.outputs import owned

def do(folder):
    script = Path(f"{folder}.script")
    if (folder / "timing.json").exists():  # another driver was faster
        return
    with (folder / "begun").open("a") as file:
        seen = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES")}
        seen |= {"time": time.time(), "cores": len(os.sched_getaffinity(0)), "process": os.getpid()}
        print(json.dumps(seen), file=file)
    ends = json.loads(script.read_text()) if script.exists() else []
    script.write_text(json.dumps(ends[1:]))
    end = ends[0] if ends else "done"
    while end == "wait" and not (folder.parent / "go").exists():
        time.sleep(0.02)
    print("its last line", flush=True)
    if end == "kill":
        os.kill(os.getpid(), 9)
    if end == "defect":
        raise ValueError("what is wrong\\nand more of it")
    if isinstance(end, int):
        sys.exit(end)
    (folder / "config.json").write_text(json.dumps(RECORD))
    (folder / "timing.json").write_text("{}")
    with (folder / "ended").open("a") as file:
        print(time.time(), file=file)

words = sys.argv[1:]
folders = [Path(words[at + 1]) for at, word in enumerate(words) if word == "--out"] or [Path(words[0])]
with ExitStack() as stack:
    for folder in folders:
        stack.enter_context(owned(folder))
    for folder in folders:
        do(folder)
"""


def job(out: Path, name: str, *needs: str, ends: tuple[int | str, ...] = ()) -> Job:
    """A job with a given end for each attempt, and success after those.

    Args:
        out: the sweep's folder.
        name: of the job.
        needs: names of jobs that must finish first.
        ends: exit codes, "kill" (SIGKILL), "defect" (a traceback), or "wait" (success once OUT/go exists).
    """
    out.mkdir(exist_ok=True)
    (out / f"{name}.script").write_text(json.dumps(ends))
    return Job(name, "pretrain", out / name, [str(out / name)], list(needs), recipe=recipe(RECORD, {}))


def policy(out: Path, name: str, *needs: str, ends: tuple[int | str, ...] = (), updates: int = 40) -> Job:
    """A fine-tuning job, as `job`, which can be stacked with jobs of equal `updates`."""
    encoder = out / (needs[-1] if needs else name) / "encoder"
    words = ["finetune", "--updates", str(updates), "--encoder", str(encoder), "--out", str(out / name)]
    return replace(job(out, name, *needs, ends=ends), section="finetune", words=words)


def keep_plan(out: Path, *jobs: Job, name: str = "plan") -> Plan:
    """Store a plan of such jobs."""
    program = out / "program.py"
    if not program.exists():
        program.write_text(PROGRAM.replace("RECORD", repr(RECORD)))
    return SweepFolder(out).keep_plan(name, jobs, [str(program)])


def begun(job: Job) -> list[dict]:
    """The environment that each process of a job recorded."""
    path = job.folder / "begun"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def until(holds: Callable[[], object], seconds: float = 300.0) -> None:
    """Wait until `holds()` is true; on a busy machine a Ray job takes minutes to start."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.05)
