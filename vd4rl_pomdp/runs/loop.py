"""The loop that all trainings share: restore, count steps, log, save, and stop at a signal without losing a step."""

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

    step: int  # steps done so far

    def state(self) -> State:
        """Everything needed to resume bit-identically."""

    def restore(self, state: State) -> None:
        """Resume from `state`."""


class Loop:
    """The remaining steps of a training; created by `training`.

    for step in loop:
        loop.add(losses_of_one_step())  # the body does the step and increments `learner.step`
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
        """Yield each step's number; after the body, save a checkpoint if one is due or a signal arrived."""
        return in_step([self], self._total)

    def due(self, every: int) -> bool:
        """Whether the step just done is a multiple of `every`, or the last one."""
        return self._learner.step % every == 0 or self._learner.step == self._total

    def add(self, logs: dict[str, Tensor]) -> None:
        self._means.add(logs)

    def log(self, *shown: str, **more: float) -> None:
        """Write a row of metrics: means since the previous row, and `more`.

        The progress line shows the numbers named in `shown`, or all.
        """
        row = self._means.take() | more
        self._log.write(self._learner.step, row)
        self._progress.advance(0, **{name: row[name] for name in shown or row})

    def log_evaluation(self, row: dict[str, float]) -> None:
        """Write the results of an evaluation after the step just done; names begin with `metrics.EVALUATION`."""
        self._log.write(self._learner.step, row)

    def show(self, **numbers: float) -> None:
        self._progress.advance(0, **numbers)

    def require_finite(self, module: nn.Module) -> None:
        """Raise FloatingPointError if a weight is not finite. Logged losses would miss damage done by the last step."""
        if not all(weights.isfinite().all() for weights in module.parameters()):
            raise FloatingPointError(f"{self._run.path}: weights are not finite after step {self._learner.step}")


def in_step(loops: Sequence[Loop], until: int) -> Iterator[int]:
    """Yield step numbers up to `until` for loops trained in lockstep by one body, which may remove some of them."""
    while loops and loops[0]._learner.step < until:
        yield loops[0]._learner.step + 1
        for loop in loops:
            loop._progress.advance()
        # Only here are weights, optimiser and random streams all of the same step.
        if interrupt.asked() or any(loop.due(loop._run.config["checkpoint_every"]) for loop in loops):
            save(loops)


def save(loops: Sequence[Loop]) -> None:
    """Save a checkpoint of every loop after the step just done, then exit if a signal is pending."""
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
    """Restore a learner from the run's newest checkpoint and open its logs. Signals wait for the end of a step.

    The progress line has `title` and `unit`; without a title there is none. Trackers get the `labels` (method, task,
    quality, corruption) and `card`, the pretraining metadata of the encoder that the run uses.
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
