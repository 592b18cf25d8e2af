"""How a command ends: exit code, cause and one line for every end that is no defect of the program."""

from __future__ import annotations

import select
import signal
from collections.abc import Sequence
from dataclasses import dataclass

from vd4rl_pomdp.cli.dispatch import run_stage
from vd4rl_pomdp.core.errors import DIVERGED, DONE, INTERRUPTED, DivergedError, UserError, disk_error, in_one_line
from vd4rl_pomdp.runs import interrupt


@dataclass(frozen=True)
class End:
    """What is left of a command."""

    code: int = 0
    cause: str = DONE
    """done, diverged, interrupted, or the `cause` of a UserError."""
    line: str = ""
    """What the user is told, empty if nothing is."""


def run_to_end(words: Sequence[str], second: signal.Handlers = signal.SIG_DFL) -> End:
    """Do what `vd4rl-pomdp WORDS` does; only a defect is raised.

    Args:
        words: the command line.
        second: what a second signal does.
    """
    try:
        _refuse_undecodable(words)
        with interrupt.handled(second):
            run_stage(list(words))
    except UserError as error:
        return End(error.code, error.cause, f"error: {in_one_line(error)}")
    except FloatingPointError as error:
        precision = "--update-precision" if words[:1] == ["finetune"] else "--precision"
        usual = f"lower --learning-rate or use {precision} fp32"
        remedy = error.remedy if isinstance(error, DivergedError) else usual
        return End(1, DIVERGED, f"error: training diverged, {error}; {remedy}")
    except KeyboardInterrupt as error:
        return End(130, INTERRUPTED, _ended("interrupted", str(error)))
    except interrupt.Terminated as error:
        return End(143, INTERRUPTED, _ended("terminated", error.reason))
    except BrokenPipeError:
        if not _nobody_reads():  # a pipe of its own
            raise
        return End(141, INTERRUPTED)
    except OSError as error:
        told = disk_error(error.filename, error)
        return End(told.code, told.cause, f"error: {told}")
    except Exception:
        if (number := interrupt.arrived()) is None:
            raise
        return End(128 + number, INTERRUPTED, _ended("ended by a signal", ""))  # raised in an import, which hid it
    return End()


def _nobody_reads() -> bool:
    """Whether what read this process's output is gone, as `head` goes."""
    poll = select.poll()
    for stream in (1, 2):
        poll.register(stream, 0)  # what is always told: that the other end is closed
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _ended(how: str, kept: str) -> str:
    """One line for a signal's end; what was `kept` is where a training loop stood."""
    where = f"{kept}; re-run the same command to resume" if kept else "re-run the same command to resume"
    return f"{how}: {where}"


def _refuse_undecodable(words: Sequence[str]) -> None:
    """Names and paths go into files and pages, which are UTF-8."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UserError(f"{word!a} is not UTF-8: use another name") from None
