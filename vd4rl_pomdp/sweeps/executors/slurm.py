"""Jobs as tasks of Slurm arrays, submitted by submitit: each task is an allocation in which several jobs run at a time.

An array is known by its job name, which is also the name of its folder. The folder is written before the array is
submitted, and the queue says whether the array is there; so a driver that is started anew finds what an earlier one has
submitted, also what still waits in the queue, and waits for it instead of submitting it twice.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from secrets import token_hex

from vd4rl_pomdp.core.errors import OutOfMemoryError, UnavailableError, UserError, disk_errors
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.executors.allocation import IDLE_S, Allocation
from vd4rl_pomdp.sweeps.executors.handover import Handover
from vd4rl_pomdp.sweeps.executors.local import PATIENCE_S
from vd4rl_pomdp.sweeps.executors.slurm_queue import (
    PREFIX,
    QUEUE_S,
    Queue,
    SlurmOptions,
    TaskState,
    cancel,
    read_queue,
    require_slurm,
    submit,
)
from vd4rl_pomdp.sweeps.work import FAILED, INTERRUPTED, KILLED, Ended, Work, last_line

FILES_S = 1.0
"""Seconds between two looks at the files that tell how jobs ended; the queue is asked less often."""
AGAIN_S = 60.0
"""Seconds until an array is submitted again that Slurm did not take."""
_GONE = "gone"
"""TaskState of a task that the queue does not know."""
_USUAL = ("None", "Priority", "Resources", "BeginTime", "Cleaning", "JobArrayTaskLimit")
"""What a task waits for that comes by itself."""
OVER = {
    **dict.fromkeys(("BOOT_FAIL", "CANCELLED", "DEADLINE", "NODE_FAIL", "PREEMPTED", "TIMEOUT", _GONE), KILLED),
    **{"COMPLETED": INTERRUPTED, "FAILED": FAILED, "OUT_OF_MEMORY": OutOfMemoryError.cause},
}
"""Slurm's states of a task that has ended, and why the jobs in it did that have not told themselves. A task that ends
in peace with jobs left was asked to."""
_UNKNOWN = TaskState(_GONE, "unknown")


@dataclass(eq=False)
class _Task:
    """A task of an array, as far as this driver knows."""

    array: Handover
    number: int
    places: int
    left: dict[str, Work] = field(default_factory=dict)
    """Attempts that have not ended."""
    mine: dict[str, str] = field(default_factory=dict)
    """Those of them that this driver waits for: attempts by job."""
    busy: float = field(default_factory=time.monotonic)
    """When it last had something to do."""

    @property
    def key(self) -> tuple[str, int]:
        return self.array.folder.name, self.number

    @property
    def slots(self) -> int:
        """What this driver's jobs take of it."""
        return sum(self.left[attempt].slots for attempt in self.mine.values())

    @property
    def free(self) -> int:
        """Places without a job; none where the task may be about to end for want of jobs."""
        if not self.left and time.monotonic() - self.busy > IDLE_S / 2:
            return 0
        return self.places - sum(work.slots for work in self.left.values())

    def add(self, work: Work) -> None:
        attempt = self.array.add(self.number, work)
        self.left[attempt], self.mine[work.name], self.busy = work, attempt, time.monotonic()

    def take_over(self, work: Work) -> bool:
        """Wait for an attempt at the same that another driver has handed over; whether there is one."""
        alike = (name for name, other in self.left.items() if (other.name, other.words) == (work.name, work.words))
        if found := next(alike, None):
            self.mine[work.name] = found
        return found is not None

    def told(self, over: set[str]) -> Iterator[Ended]:
        """Of the attempts that are over, what has ended since the last call.

        Where the disk does not tell now, the next one does.
        """
        with suppress(UnavailableError), disk_errors(self.array.folder):
            for attempt in over & self.left.keys():
                ended, name = self.array.end_of(attempt), self.left[attempt].name
                del self.left[attempt]
                self.busy = time.monotonic()
                if self.mine.get(name) == attempt:
                    del self.mine[name]
                    yield ended

    def untold(self, state: TaskState, stopped: bool) -> list[Ended]:
        """How its jobs ended when it has ended itself; what this driver has `stopped` was not killed."""
        line = last_line(self.array.folder / f"{state.job}_0_log.out") if state.name == "FAILED" else ""
        line = line or f"Slurm says {state.name} of task {state.job}"
        cause = INTERRUPTED if stopped and OVER[state.name] == KILLED else OVER[state.name]
        return [Ended(name, cause, line) for name in self.mine]


class SlurmExecutor:
    """Arrays of allocations."""

    def __init__(self, options: SlurmOptions, folder: Path) -> None:
        """Finds what earlier drivers of the same sweep have in the queue.

        Args:
            options: what to ask Slurm for.
            folder: for the arrays, on a disk that all nodes share.

        Raises:
            UserError: submitit or Slurm's commands are missing, or Slurm does not answer.
        """
        require_slurm()
        self._options, self._folder = options, folder
        self.largest = -(-options.jobs_per_task // max(1, options.gpus))
        self.slots = options.tasks * options.jobs_per_task
        self._tasks = _known(folder, options.jobs_per_task)
        self._fresh: list[_Task] = []
        """Tasks of the array that is not submitted yet."""
        self._accepted = False
        """Whether Slurm has taken an array of these options."""
        self._queue: Queue = {}
        """What Slurm told last."""
        self._stopped = False
        self._answers = True
        """Whether Slurm did when it was asked last."""
        self._warned: list[str] = []
        self._next_files = self._next_queue = self._next_submission = 0.0

    def fits(self, slots: int) -> bool:
        """Whether so many slots wait for a job."""
        return sum(task.slots for task in self._tasks + self._fresh) + slots <= self.slots

    def start(self, work: Work) -> None:
        """Begin a job: wait for an earlier driver's attempt, use a free place, or have a new task submitted."""
        if not any(task.take_over(work) for task in self._tasks):
            self._place(work.slots).add(work)

    def _place(self, slots: int) -> _Task:
        """A task with so many free places, a new one, or where there are enough of them the least busy one."""
        tasks = self._tasks + self._fresh
        best = max(tasks, key=lambda task: task.free, default=None)
        if best is not None and (best.free >= slots or len(tasks) >= self._options.tasks):
            return best
        array = self._fresh[0].array if self._fresh else _new_array(self._folder)
        self._fresh.append(_Task(array, len(self._fresh), self._options.jobs_per_task))
        return self._fresh[-1]

    def ended(self) -> list[Ended]:
        """What has ended since the last call. All that was started since then becomes one array.

        Raises:
            UserError: Slurm refuses the first array.
        """
        now = time.monotonic()
        if self._fresh and now >= self._next_submission:
            self._submit()
        answered = False
        if now >= self._next_queue:
            self._next_queue, answered = now + QUEUE_S, self._ask()
            self._warn()
        if not answered and now < self._next_files:
            return []
        self._next_files = now + FILES_S
        over = {array: _over(array) for array in {task.array for task in self._tasks}}
        found = [ended for task in self._tasks for ended in task.told(over[task.array])]  # after the queue: all of them
        return found + self._gone() if answered else found

    def _ask(self) -> bool:
        """Read the queue; whether Slurm answers, and if it does not, what it told last stays."""
        queue = read_queue()
        if queue is not None:
            self._queue = queue
        elif self._answers:
            print("warning: Slurm does not answer: see what squeue says; it is asked again", file=sys.stderr)
        self._answers = queue is not None
        return self._answers

    def _state(self, task: _Task) -> TaskState:
        """What Slurm told last of a task."""
        return self._queue.get(task.key, _UNKNOWN)

    def _warn(self) -> None:
        """Say, once each, what tasks wait for that may never come."""
        for state in map(self._state, self._tasks):
            if state.name == "PENDING" and state.reason not in (*_USUAL, *self._warned):
                self._warned.append(state.reason)
                print(f"warning: Slurm keeps task {state.job} waiting: {state.reason}", file=sys.stderr)

    def _gone(self) -> list[Ended]:
        """Jobs in tasks that have ended without telling of them."""
        over = [task for task in self._tasks if self._state(task).name in OVER]
        self._tasks = [task for task in self._tasks if task not in over]
        return [ended for task in over for ended in task.untold(self._state(task), self._stopped)]

    def _submit(self) -> None:
        """Submit what was gathered; a failure is waited out where Slurm took such an array before, or the disk is full.

        A signal waits until the array is known, which could not be taken out of the queue otherwise.
        """
        with interrupt.deferred():
            try:
                array = self._named_anew() if self._next_submission else self._fresh[0].array.folder
                submit(array, [Allocation(array, task.number, task.places) for task in self._fresh], self._options)
            except UserError as error:
                if not (self._accepted or isinstance(error, UnavailableError)):
                    raise
                print(f"warning: {error}; trying again in {AGAIN_S:.0f} s", file=sys.stderr)
                self._next_submission = time.monotonic() + AGAIN_S
                return
            self._accepted, self._next_submission = True, 0.0
            self._tasks, self._fresh = self._tasks + self._fresh, []

    def _named_anew(self) -> Path:
        """Another name for the array that is not submitted yet: Slurm may have taken it without saying so.

        What Slurm has of the old name then finds no folder, and ends.
        """
        old, new = self._fresh[0].array.folder, _new_array(self._folder)
        with disk_errors(old):
            if old.is_dir():
                old.rename(new.folder)
        for task in self._fresh:
            task.array = new
        return new.folder

    def stop(self) -> None:
        """Take what waits out of the queue, ask every job to end where nothing is lost, and wait for it."""
        self._fresh, self._stopped = [], True
        try:
            cancel(self._live(), "--state=PENDING")
            cancel(self._live(), "--signal=TERM")
            until = time.monotonic() + PATIENCE_S + QUEUE_S
            while self._live() and time.monotonic() < until:
                time.sleep(FILES_S)
            cancel(self._live())
        except UnavailableError as error:
            print(f"warning: {error}; see what squeue has of {self._folder}, and end it by scancel", file=sys.stderr)
        self._next_queue = 0.0

    def _live(self) -> list[str]:
        """Slurm's numbers of this sweep's tasks that have not ended, as far as it has told."""
        self._ask()
        return [state.job for state in map(self._state, self._tasks) if state.name not in OVER]


def _new_array(folder: Path) -> Handover:
    return Handover(folder / f"{PREFIX}{token_hex(4)}")


def _over(array: Handover) -> set[str]:
    """Attempts of an array that have ended, as far as the disk tells now."""
    with suppress(UnavailableError), disk_errors(array.folder):
        return array.ended()
    return set()


def _known(folder: Path, places: int) -> list[_Task]:
    """Tasks that earlier drivers have in the queue."""
    queue = read_queue()
    if queue is None:
        raise UnavailableError("Slurm does not answer: see what squeue says")
    found = []
    for (name, number), state in queue.items():
        array = Handover(folder / name)
        if state.name not in OVER and array.folder.is_dir():
            found.append(_Task(array, number, places, array.left(number)))
    return found
