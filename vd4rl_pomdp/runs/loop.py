"""What every training loop needs around its steps: the newest checkpoint, metrics, progress, and an end on a signal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Protocol

from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.checkpoint import State
from vd4rl_pomdp.runs.metrics import MetricsLog
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.run import RunFolder


class Learner(Protocol):
    """What a loop trains."""

    step: int
    """Steps done."""

    def state(self) -> State:
        """Everything needed to go on to the bit."""

    def restore(self, state: State) -> None:
        """Go on from `state`."""


class Loop:
    """A learner on its way to its last step; made by `training`."""

    def __init__(self, run: RunFolder, learner: Learner, total: int, log: MetricsLog, progress: ProgressLine) -> None:
        self._run, self._learner, self._total = run, learner, total
        self._log, self._progress = log, progress

    def due(self, every: int) -> bool:
        """Whether the step just done is one of every so many, or the last."""
        return self._learner.step % every == 0 or self._learner.step == self._total

    def log(self, row: dict[str, float], *shown: str) -> None:
        """Write a row of metrics; the numbers named in `shown`, or all, stand in the progress line."""
        self._log.write(self._learner.step, row)
        self.show(**{name: row[name] for name in shown or row})

    def show(self, **numbers: float) -> None:
        """Show numbers in the progress line."""
        self._progress.advance(0, **numbers)

    def step_done(self, save: bool) -> None:
        """Count a step; save a checkpoint if it is time to, or if a signal asks for the end, which then comes."""
        self._progress.advance()
        if save or interrupt.asked():
            self._run.save(self._learner.step, self._learner.state())
        interrupt.check(f"{self._run.path} keeps step {self._learner.step}")


@contextmanager
def training(run: RunFolder, learner: Learner, title: str, total: int, unit: str = "steps") -> Iterator[Loop]:
    """Restore a learner from a run's newest checkpoint and open what its loop writes; signals wait for a step's end."""
    run.restore(learner.restore)
    log = MetricsLog(run.path / "metrics.jsonl", learner.step, run.config["wandb"], run.config)
    with closing(log), ProgressLine(title, total, unit, learner.step) as progress, interrupt.deferred():
        yield Loop(run, learner, total, log, progress)
