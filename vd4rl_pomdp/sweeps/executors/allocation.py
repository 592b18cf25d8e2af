"""What one task of a Slurm array does: several jobs of the sweep at a time on the node that it was given.

Jobs come as files, also while it runs, so that a task whose jobs have ended takes the next ones instead of going back
into the queue. SIGTERM, and the signal that Slurm sends before the time limit, end its jobs where nothing is lost; jobs
that were ended so have not ended for whoever handed them over: when Slurm starts the task again, it goes on with them.
"""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_errors
from vd4rl_pomdp.sweeps.executors.handover import Handover
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions, visible_gpus
from vd4rl_pomdp.sweeps.work import INTERRUPTED, KILLED, Ended, Work

IDLE_S = 30.0
"""On network file systems a new job may be seen that late."""
POLL_S = 0.5
WARNING = signal.SIGUSR2
"""What submitit has Slurm send before the time limit, and what makes it start the task again."""


@dataclass
class Allocation:
    """A task, as submitit takes it: a function that can be called anew after an interruption."""

    folder: Path
    """Of the array."""
    number: int
    """Which of its tasks this is."""
    jobs: int
    """At a time."""
    idle_s: float = IDLE_S
    """Without a job for so long it ends."""
    _asked: list[int] = field(default_factory=list)
    """Signals that have arrived."""
    _attempts: dict[str, str] = field(default_factory=dict)
    """Attempts that run, or have ended and wait to be told of, by job."""
    _untold: list[Ended] = field(default_factory=list)

    def __call__(self) -> None:
        """Do what is handed over until there has been nothing for `idle_s`, or a signal asks to end."""
        requeue = signal.getsignal(WARNING)
        for number in (signal.SIGTERM, WARNING):
            signal.signal(number, self._note)
        self._work(_executor(self.jobs))
        if WARNING in self._asked and callable(requeue) and Handover(self.folder).left(self.number):
            requeue(WARNING, None)  # submitit's: it calls `checkpoint`, puts the task into the queue and exits

    def checkpoint(self) -> Any:
        """What submitit calls when the task is started again: the same."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(Allocation(self.folder, self.number, self.jobs, self.idle_s))

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._asked.append(number)

    def _work(self, executor: LocalExecutor) -> None:
        handed = Handover(self.folder)
        until = time.monotonic() + self.idle_s
        while time.monotonic() < until and not self._asked:
            with suppress(UnavailableError), disk_errors(self.folder):  # the next time, then
                self._begin(executor, handed.left(self.number))
            time.sleep(POLL_S)
            if self._attempts:
                until = time.monotonic() + self.idle_s
            self._tell(executor, handed)
        executor.stop()
        self._tell(executor, handed)

    def _begin(self, executor: LocalExecutor, left: dict[str, Work]) -> None:
        """Start what there is room for, in the order in which it was handed over."""
        for attempt, work in left.items():
            if work.name in self._attempts:
                continue
            work = replace(work, slots=min(work.slots, executor.largest))  # handed over by a driver of other options
            if not executor.fits(work.slots):
                return
            self._attempts[work.name] = attempt
            try:
                with disk_errors(work.log):
                    executor.start(work)
            except UserError as error:
                self._untold.append(Ended(work.name, error.cause, str(error)))

    def _tell(self, executor: LocalExecutor, handed: Handover) -> None:
        """Write how jobs ended; on a disk that takes nothing now, the next time."""
        self._untold += executor.ended()
        while self._untold:
            ended = self._untold[0]
            if not self._goes_on(ended):
                try:
                    handed.end(self._attempts[ended.name], ended)
                except UnavailableError:
                    return
            del self._attempts[ended.name], self._untold[0]

    def _goes_on(self, ended: Ended) -> bool:
        """Whether a job was ended from outside, so that its attempt is not over."""
        return ended.cause == INTERRUPTED or (bool(self._asked) and ended.cause == KILLED)


def _executor(jobs: int) -> LocalExecutor:
    """A pool of so many places, evenly on the GPUs of this task if it has any."""
    return LocalExecutor(LocalOptions(jobs, -(-jobs // max(1, len(visible_gpus())))))
