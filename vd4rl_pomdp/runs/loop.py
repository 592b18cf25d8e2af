"""The loop that every training shares: restore, count steps, log, save, and end on a signal without losing a step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import Any, Protocol

from torch import Tensor, nn

from vd4rl_pomdp.runs import METRICS_FILE, interrupt
from vd4rl_pomdp.runs.checkpoint import State
from vd4rl_pomdp.runs.metrics import Means, MetricsLog, mirrors_of
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.run import RunFolder


class Learner(Protocol):
    """What a loop trains."""

    step: int
    """Steps done."""

    def state(self) -> State:
        """Everything needed to resume to the bit."""

    def restore(self, state: State) -> None:
        """Resume from `state`."""


class Loop:
    """The steps that are left of a training; made by `training`.

    for step in loop:
        loop.add(losses_of_one_step())  # the body does the step and counts it in `learner.step`
        if loop.due(config.log_every):
            loop.log("loss")
    """

    def __init__(
        self, run: RunFolder, learner: Learner, means: Means, total: int, log: MetricsLog, progress: ProgressLine
    ) -> None:
        self._run, self._learner, self._means, self._total = run, learner, means, total
        self._log, self._progress = log, progress
        self._saved = learner.step

    def __iter__(self) -> Iterator[int]:
        """Number of each step, which the loop's body does; its state is then saved if that is due, or a signal came."""
        return in_step([self], self._total)

    def due(self, every: int) -> bool:
        """Whether the step just done is one of every so many, or the last."""
        return self._learner.step % every == 0 or self._learner.step == self._total

    def add(self, logs: dict[str, Tensor]) -> None:
        """Count the scalars of the step just done for the next row of metrics."""
        self._means.add(logs)

    def log(self, *shown: str, **more: float) -> None:
        """Write a row of metrics: means over the steps since the row before, and `more`.

        The numbers named in `shown`, or all, stand in the progress line.
        """
        row = self._means.take() | more
        self._log.write(self._learner.step, row)
        self.show(**{name: row[name] for name in shown or row})

    def log_evaluation(self, row: dict[str, float]) -> None:
        """Write what an evaluation after the step just done gave, by names that begin with `metrics.EVALUATION`."""
        self._log.write(self._learner.step, row)

    def show(self, **numbers: float) -> None:
        """Show numbers in the progress line."""
        self._progress.advance(0, **numbers)

    def require_finite(self, module: nn.Module) -> None:
        """Raise FloatingPointError if a weight is not finite: what the last step did stands in no row of metrics."""
        if not all(weights.isfinite().all() for weights in module.parameters()):
            raise FloatingPointError(f"{self._run.path}: weights are not finite after step {self._learner.step}")


def in_step(loops: Sequence[Loop], until: int) -> Iterator[int]:
    """Number of each step, up to `until`, of loops whose learners one body trains, all after the same step.

    Loops that are taken out meanwhile are left alone.
    """
    while loops and loops[0]._learner.step < until:
        yield loops[0]._learner.step + 1
        for loop in loops:
            loop._progress.advance()
        # Here alone is a step whole: weights, optimiser and random streams are all of the same step.
        if interrupt.asked() or any(loop.due(loop._run.config["checkpoint_every"]) for loop in loops):
            save(loops)


def save(loops: Sequence[Loop]) -> None:
    """Keep the states of all after the step just done, and end here if a signal asks for it."""
    for loop in loops:
        step = loop._learner.step
        if step != loop._saved:
            loop._run.save(step, {"learner": loop._learner.state(), "means": loop._means.state_dict()})
            loop._saved = step
    interrupt.check(", ".join(f"{loop._run.path} keeps step {loop._learner.step}" for loop in loops))


@contextmanager
def training(
    run: RunFolder,
    learner: Learner,
    title: str,
    total: int,
    unit: str = "steps",
    *,
    labels: Mapping[str, Any],
    card: Mapping[str, Any] | None = None,
) -> Iterator[Loop]:
    """Restore a learner from a run's newest checkpoint and open what its loop writes; signals wait for a step's end.

    Args:
        run: the run.
        learner: what is trained.
        title: what the progress line says; empty: it is not shown.
        total: the step at which the loop ends.
        unit: what the progress line counts.
        labels: what names the run where it is tracked: method, task, quality, corruption.
        card: what the encoder that it started from says of its pretraining, if there is one.
    """
    means = Means()

    def restore(state: State) -> None:
        learner.restore(state["learner"])
        means.load_state_dict(state["means"])

    run.restore(restore)
    log = MetricsLog(run.path / METRICS_FILE, learner.step, mirrors_of(run, labels, card or {}))
    with closing(log), ProgressLine(title, total, unit, learner.step) as progress, interrupt.deferred():
        try:
            yield Loop(run, learner, means, total, log, progress)
        except FloatingPointError as error:
            run.mark_diverged(learner.step, str(error))
            raise
