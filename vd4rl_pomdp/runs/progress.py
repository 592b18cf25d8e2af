"""Live progress on the terminal: what runs, how far, how fast, how long still, and the newest numbers."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class ProgressLine:
    """A progress bar on stderr; where that is no terminal, a plain line now and then."""

    _PLAIN_LINES = 10

    def __init__(self, title: str, total: int, unit: str, start: int = 0) -> None:
        self._console = Console(stderr=True)
        self._title, self._total, self._unit, self._done = title, total, unit, start
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(elapsed_when_finished=False),
            TextColumn("{task.fields[note]}"),
            console=self._console,
            disable=not self._console.is_terminal,
            speed_estimate_period=120,
        )
        self._task = self._bar.add_task(title, total=total, completed=start, speed="", note="")
        self._next_plain = start + max(1, (total - start) // self._PLAIN_LINES)

    def advance(self, amount: int = 1, **numbers: float) -> None:
        """Move on by `amount`, showing `numbers` when given."""
        self._done += amount
        self._bar.advance(self._task, amount)
        if numbers:
            self._bar.update(self._task, note="  ".join(f"{k} {v:.4g}" for k, v in numbers.items()))
        speed = self._bar.tasks[0].speed
        if speed:
            self._bar.update(self._task, speed=f"{speed:.3g} {self._unit}/s")
        if not self._console.is_terminal and self._done >= self._next_plain:
            note = "  ".join(f"{k} {v:.4g}" for k, v in numbers.items())
            print(
                f"{self._title}: {self._done}/{self._total} {self._unit}  {note}", file=self._console.file, flush=True
            )
            self._next_plain += max(1, self._total // self._PLAIN_LINES)

    def reach(self, done: int, **numbers: float) -> None:
        """Move on to `done`, showing `numbers`."""
        self.advance(done - self._done, **numbers)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
