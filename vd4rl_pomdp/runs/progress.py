"""Progress on the terminal: what runs, how far, speed, ETA and the newest numbers."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class ProgressLine:
    """A progress bar on stderr. If that is no terminal, a plain line per 10% of progress and per 30 s.

    Nothing is shown without a title.
    """

    _PLAIN_LINES = 10
    _PLAIN_S = 30.0

    def __init__(
        self, title: str, total: int, unit: str, start: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console, self._shown = Console(stderr=True), bool(title)
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
            disable=not (self._console.is_terminal and title),
            speed_estimate_period=120,
        )
        self._task = self._bar.add_task(title, total=total, completed=start, speed="", note="")
        self._note = ""
        self._clock, self._first = clock, (start, clock())
        self._plain = self._first  # progress and time at the last plain line

    def advance(self, amount: int = 1, **numbers: float) -> None:
        self._done += amount
        self._bar.advance(self._task, amount)
        if numbers:
            self._note = "  ".join(f"{k} {v:.4g}" for k, v in numbers.items())
            self._bar.update(self._task, note=self._note)
        if speed := self._bar.tasks[0].speed:
            self._bar.update(self._task, speed=f"{speed:.3g} {self._unit}/s")
        if not amount or not self._shown or self._console.is_terminal:
            return
        now = self._clock()
        done, then = self._plain
        a_tenth_on = self._done - done >= max(1, (self._total - self._first[0]) // self._PLAIN_LINES)
        if a_tenth_on or now - then >= self._PLAIN_S or self._done == self._total:
            self._plain = self._done, now
            parts = [f"{self._title}: {self._done}/{self._total} {self._unit}", self._note]
            start, begun = self._first  # this process only, not before a resume
            if now > begun and self._done > start:
                speed = (self._done - start) / (now - begun)
                left = timedelta(seconds=round(max(0, self._total - self._done) / speed))
                parts.append(f"{speed:.3g} {self._unit}/s  ETA {left}")
            print("  ".join(filter(None, parts)), file=self._console.file, flush=True)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()
