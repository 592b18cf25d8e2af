"""Signals: the first Ctrl-C, SIGTERM or SIGHUP ends a command where nothing is lost, a second one ends it at once.

The first one is raised where it arrives, or within `deferred` at the next `check`: a training loop ends its step.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; the message says from where the run resumes, if it does."""


class Terminated(SystemExit):
    """SIGTERM or a closed terminal, with the exit code that shells give SIGTERM; the message is in `reason`."""

    def __init__(self, reason: str = "") -> None:
        super().__init__(128 + signal.SIGTERM)
        self.reason = reason


class _Signals:
    """Whether signals are answered or wait in this process, and which of them arrived last."""

    handled = deferred = False
    arrived: int | None = None


@contextmanager
def handled(second: signal.Handlers | None = None) -> Iterator[None]:
    """Answer signals as the module says; what is ignored, as under nohup, stays so.

    Nested, or outside the main thread, this changes nothing.

    Args:
        second: what a second signal does: SIG_DFL on the command line, which kills the process even inside a library's
            C code; SIG_IGN where whoever sent the first will kill the process himself; None: what it did before.
    """
    if _Signals.handled or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: old for number, old in before.items() if old not in (None, signal.SIG_IGN)}

    def answer(number: int, frame: FrameType | None) -> None:
        # Whoever presses Ctrl-C twice does not want to wait for a checkpoint.
        for other, old in before.items():
            signal.signal(other, old if second is None else second)
        if sys.stderr.isatty():
            sys.stderr.write("\x1b[?25h")  # a second signal leaves nobody to show the cursor again
        _Signals.arrived = number
        if not _Signals.deferred:
            check()

    _Signals.handled, _Signals.arrived = True, None
    for number in before:
        signal.signal(number, answer)
    try:
        yield
    finally:
        _Signals.handled = False
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def deferred(value: bool = True) -> Iterator[None]:
    """Within the block a signal waits for the next `check`, at the latest that at its end; False: it does not wait."""
    before, _Signals.deferred = _Signals.deferred, value
    try:
        if not value:
            check()
        yield
    finally:
        _Signals.deferred = before
    check()


def asked() -> bool:
    """Whether a signal has arrived and waits for an answer."""
    return _Signals.handled and _Signals.arrived is not None


def check(reason: str = "") -> None:
    """Raise Interrupted or Terminated if a signal has arrived; `reason` says from where the run resumes."""
    if asked():
        raise Interrupted(reason) if _Signals.arrived == signal.SIGINT else Terminated(reason)
