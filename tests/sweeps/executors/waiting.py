"""Jobs that take as long as a test wants: real commands that read a grid in Python, which waits for a file.

`python -m tests.sweeps.executors.waiting OUT N` is a driver on Slurm of N such jobs.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.sweeps.driver import Driver
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import Ended, Executor, Work

GRID = """
import json, os, time
from pathlib import Path
from vd4rl_pomdp.runs.ownership import owned
here = Path(__file__).parent
names = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES")
with owned(here):
    with (here / "begun").open("a") as file:
        file.write(json.dumps({name: os.environ.get(name) for name in names} | {"cwd": os.getcwd()}) + "\\n")
    while not (here.parent / "go").exists() and not (here / "go").exists():
        time.sleep(0.05)
    (here / "provenance.json").write_text("{}")
GRID = {"collect": {"task": "walker_walk", "quality": "expert"}}
"""
PATIENCE_S = 150.0


def waiting_job(out: Path, name: str) -> Job:
    """A job that is finished soon after OUT/go or OUT/NAME/go is there."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "grid.py").exists():  # or a process might read half of it
        (folder / "grid.py").write_text(GRID)
    words = ("sweep", "run", str(folder / "grid.py"), "--out", str(folder / "runs"), "--dry-run")
    return Job(name, "collect", folder, words)


def work_of(job: Job, slots: int = 1) -> Work:
    return SweepFolder(job.folder.parent).work(job, slots)


def begun(job: Job) -> list[Row]:
    """What each of its processes saw of its environment."""
    path = job.folder / "begun"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def until(holds: Callable[[], object]) -> None:
    """Wait for what must become true."""
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.05)


def run(
    executor: Executor, number: int, meanwhile: Callable[[list[Ended]], object] = lambda found: None
) -> list[Ended]:
    """Wait until so many jobs have ended; how."""
    found: list[Ended] = []

    def enough() -> bool:
        found.extend(executor.ended())
        meanwhile(found)
        return len(found) >= number

    until(enough)
    return found


def main() -> None:
    from vd4rl_pomdp.sweeps.executors import slurm

    out, number = Path(sys.argv[1]), int(sys.argv[2])
    slurm.QUEUE_S, slurm.IDLE_S = 1.0, 4.0
    options = slurm.SlurmOptions(time=30, gpus=0, cpus=8)
    jobs = [waiting_job(out, f"job{index}") for index in range(number)]
    sys.exit(not Driver(jobs, slurm.SlurmExecutor(options, out / "sweep" / "slurm"), SweepFolder(out)).run())


if __name__ == "__main__":
    main()
