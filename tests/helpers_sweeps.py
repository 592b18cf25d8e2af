"""Sweeps without training: jobs that a scripted executor ends."""

from pathlib import Path

from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.runs.identity import recipe
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import DONE, Ended, Work

_RECORD = {"stage": "pretrain", "config": {"seed": 0}}


def job(out: Path, name: str, *needs: str, section: str = "pretrain") -> Job:
    return Job(name, section, out / name, ("list",), needs, recipe=recipe(_RECORD, {}), content="its set")


def finish(folder: Path, seed: int = 0, content: str = "its set") -> None:
    """Leave what a finished run leaves, one of another recipe for another seed, or on another set."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "config.json", _RECORD | {"config": {"seed": seed}, "inputs": {"data": content}})
    write_json(folder / "timing.json", {"seconds": 1.0})


class Scripted:
    """An executor whose jobs end as a script says, one cause an attempt, and then in success; a poll ends them all."""

    def __init__(self, jobs: list[Job], script: dict[str, list[str]] | None = None, slots: int = 2) -> None:
        self.folders = {job.name: job.folder for job in jobs}
        self.script = script or {}
        self.slots = self.largest = slots
        self.started: list[tuple[str, int]] = []
        self.running: list[Work] = []
        self.most = 0
        self.stopped = False

    def fits(self, slots: int) -> bool:
        return sum(work.slots for work in self.running) + slots <= self.slots

    def start(self, work: Work) -> None:
        self.started.append((work.name, work.slots))
        self.running.append(work)
        self.most = max(self.most, sum(work.slots for work in self.running))

    def ended(self) -> list[Ended]:
        over, self.running = self.running, []
        return [self._end(work.name) for work in over]

    def _end(self, name: str) -> Ended:
        causes = self.script.get(name, [])
        cause = causes.pop(0) if causes else DONE
        if cause == DONE:
            finish(self.folders[name])
        return Ended(name, cause, "" if cause == DONE else f"its {cause} line")

    def stop(self) -> None:
        self.stopped = True
