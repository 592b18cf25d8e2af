"""Jobs that take as long as a test wants: real commands that read a grid in Python, which waits for a file.

`python -m tests.sweeps.executors.waiting KIND OUT N '{"options": ...}'` is a driver of N such jobs on a cluster.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.sweeps import cluster as module
from vd4rl_pomdp.sweeps.executors import CLUSTERS, EXECUTORS
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.plan import Job

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
PATIENCE_S = 200.0


def waiting_job(out: Path, name: str) -> Job:
    """A job that is finished soon after OUT/go or OUT/NAME/go is there."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "grid.py").exists():  # or a process might read half of it
        (folder / "grid.py").write_text(GRID)
    words = ("sweep", "run", str(folder / "grid.py"), "--out", str(folder / "runs"), "--dry-run")
    return Job(name, "collect", folder, words)


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


def driver(kind: str, out: Path, number: int, **options: object) -> list[str]:
    """The command of a driver of so many waiting jobs."""
    return [sys.executable, "-m", "tests.sweeps.executors.waiting", kind, str(out), str(number), json.dumps(options)]


def main() -> None:
    from vd4rl_pomdp.runs import interrupt

    kind, out, options = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[4])
    module.LOOK_S = 1.0
    jobs = [waiting_job(out, f"job{index}") for index in range(int(sys.argv[3]))]
    folder = SweepFolder(out)
    folder.keep_plan("waiting", jobs)
    with interrupt.handled():
        made = CLUSTERS[kind](EXECUTORS[kind](**options), folder.of_executor(kind))
        sys.exit(not module.watch(jobs, made, folder, "waiting"))


if __name__ == "__main__":
    main()
