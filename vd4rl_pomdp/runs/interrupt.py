"""Signals: the first Ctrl-C, SIGTERM or SIGHUP ends a command gracefully, a second one immediately.

The first is raised as an exception at once or, within `deferred`, at the next `check`, so that training ends its step.
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
    """Ctrl-C; the message says where the run will resume, if it can."""


class Terminated(SystemExit):
    """SIGTERM or a closed terminal, with a shell's exit code for SIGTERM; the message is in `reason`."""

    def __init__(self, reason: str = "") -> None:
        super().__init__(128 + signal.SIGTERM)
        self.reason = reason


class _Signals:
    """State of this process: whether signals are handled or deferred, and which one arrived last."""

    handled = deferred = False
    arrived: int | None = None


@contextmanager
def handled(second: signal.Handlers | None = None) -> Iterator[None]:
    """Handle signals as described in the module docstring. Ignored signals stay ignored, e.g. SIGHUP under nohup.

    Does nothing when nested or outside the main thread.

    Args:
        second: action for a second signal. SIG_DFL, used on the command line, kills the process even inside a library's
            C code. SIG_IGN is for processes whose parent will kill them itself. None keeps the previous handler.
    """
    if _Signals.handled or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: old for number, old in before.items() if old not in (None, signal.SIG_IGN)}

    def answer(number: int, frame: FrameType | None) -> None:
        # A second Ctrl-C means: do not wait for a checkpoint.
        for other, old in before.items():
            signal.signal(other, old if second is None else second)
        if sys.stderr.isatty():
            sys.stderr.write("\x1b[?25h")  # show the cursor: after a second signal nobody would
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
    """Within the block, signals wait for the next `check`, at latest at its end. False: handle them at once."""
    before, _Signals.deferred = _Signals.deferred, value
    try:
        if not value:
            check()
        yield
    finally:
        _Signals.deferred = before
    check()


def asked() -> bool:
    """Whether a signal has arrived and is pending."""
    return _Signals.handled and _Signals.arrived is not None


def check(reason: str = "") -> None:
    """Raise Interrupted or Terminated if a signal has arrived; `reason` says where the run will resume."""
    if asked():
        raise Interrupted(reason) if _Signals.arrived == signal.SIGINT else Terminated(reason)
