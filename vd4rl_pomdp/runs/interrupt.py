"""Signals: the first Ctrl-C or SIGTERM ends a run where nothing is lost, a second one ends the process at once.

Outside a training loop the first signal is raised where it arrives; inside one it waits for the end of the running
step, whose checkpoint is then written. A job of a sweep leaves a second one unanswered.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; the message says from where the run goes on, if it does."""


class Terminated(SystemExit):
    """SIGTERM, with the exit code that shells give it; the message is in `reason`."""

    def __init__(self, reason: str = "") -> None:
        super().__init__(128 + signal.SIGTERM)
        self.reason = reason


class _Signals:
    """Whether signals are answered or wait in this process, and which of them arrived last."""

    handled = deferred = False
    asked: int | None = None


@contextmanager
def handled(second: signal.Handlers | None = None) -> Iterator[None]:
    """Answer signals as the module says. Nested, or outside the main thread, it changes nothing.

    Args:
        second: what a second signal does: SIG_DFL on the command line, which kills the process even inside a library's
            C code; SIG_IGN where whoever sent the first will kill the process himself; None: what it did before.
    """
    if _Signals.handled or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: old for number, old in before.items() if old not in (None, signal.SIG_IGN)}  # nohup stays nohup

    def answer(number: int, frame: FrameType | None) -> None:
        for other, old in before.items():
            signal.signal(other, old if second is None else second)
        if sys.stderr.isatty():
            sys.stderr.write("\x1b[?25h")  # a second signal leaves nobody to show the cursor again
        _Signals.asked = number
        if not _Signals.deferred:
            check()

    _Signals.handled, _Signals.asked = True, None
    for number in before:
        signal.signal(number, answer)
    try:
        yield
    finally:
        _Signals.handled = False
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def hangups() -> Iterator[None]:
    """Within the block a terminal that is closed or a lost connection counts as SIGTERM; nohup stays nohup."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGHUP) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGHUP, lambda number, frame: os.kill(os.getpid(), signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@contextmanager
def deferred() -> Iterator[None]:
    """Within the block a signal waits for the next `check`, at the latest the one at the block's end."""
    with _deferring(True):
        yield
    check()


@contextmanager
def at_once() -> Iterator[None]:
    """Within this block, itself within a `deferred` one, a signal is raised where it arrives."""
    with _deferring(False):
        check()
        yield


@contextmanager
def _deferring(value: bool) -> Iterator[None]:
    before, _Signals.deferred = _Signals.deferred, value
    try:
        yield
    finally:
        _Signals.deferred = before


def asked() -> bool:
    """Whether a signal has arrived and waits for an answer."""
    return _Signals.handled and _Signals.asked is not None


def arrived() -> int | None:
    """The signal that has arrived since signals were last begun to be answered, if one has."""
    return _Signals.asked


def check(reason: str = "") -> None:
    """Raise Interrupted or Terminated if a signal has arrived; `reason` says from where the run goes on."""
    if asked():
        raise Interrupted(reason) if _Signals.asked == signal.SIGINT else Terminated(reason)


@contextmanager
def blocked() -> Iterator[None]:
    """Within the block signals stay pending; processes that are started in it never receive them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
