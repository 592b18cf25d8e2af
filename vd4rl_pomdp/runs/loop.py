"""What every training loop needs around its steps: the newest checkpoint, metrics, progress, and an end on a signal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any, Protocol

from torch import Tensor, nn

from vd4rl_pomdp.runs import METRICS_FILE, interrupt
from vd4rl_pomdp.runs.checkpoint import State
from vd4rl_pomdp.runs.metrics import Means, MetricsLog
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.sinks import open_sinks


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

    def __init__(
        self, run: RunFolder, learner: Learner, means: Means, total: int, log: MetricsLog, progress: ProgressLine
    ) -> None:
        self._run, self._learner, self._means, self._total = run, learner, means, total
        self._log, self._progress = log, progress

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
        self._write(row)
        self.show(**{name: row[name] for name in shown or row})

    def log_evaluation(self, row: dict[str, float]) -> None:
        """Write what an evaluation after the step just done gave, by names that begin with `metrics.EVALUATION`."""
        self._write(row)

    def _write(self, row: dict[str, float]) -> None:
        self.require_owner()
        self._log.write(self._learner.step, row)

    def require_finite(self, module: nn.Module) -> None:
        """Raise FloatingPointError if a weight is not finite: what the last step did stands in no row of metrics."""
        if not all(weights.isfinite().all() for weights in module.parameters()):
            raise FloatingPointError(f"{self._run.path}: weights are not finite after step {self._learner.step}")

    def require_owner(self) -> None:
        """Raise an error if another process has taken the run over."""
        self._run.require_owner()

    def show(self, **numbers: float) -> None:
        """Show numbers in the progress line."""
        self._progress.advance(0, **numbers)

    def step_done(self, save: bool) -> None:
        """Count a step; save a checkpoint if it is time to, or if a signal asks for the end, which then comes."""
        if save or interrupt.asked():
            state = {"learner": self._learner.state(), "means": self._means.state_dict()}
            self._run.save(self._learner.step, state)
        self._progress.advance()
        interrupt.check(f"{self._run.path} keeps step {self._learner.step}")


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
        title: what the progress line says.
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
    log = MetricsLog(run.path / METRICS_FILE, learner.step, open_sinks(run, labels, card or {}))
    with closing(log), ProgressLine(title, total, unit, learner.step) as progress, interrupt.deferred():
        try:
            yield Loop(run, learner, means, total, log, progress)
        except FloatingPointError as error:
            run.mark_diverged(learner.step, str(error))
            raise
