"""The command line: one subcommand a stage. Bad input ends with one line and exit code 2, never with a traceback."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from vd4rl_pomdp.cli import data, hub, navigation, parts, policy, stages, studies
from vd4rl_pomdp.cli.dispatch import COMMANDS, run_stage
from vd4rl_pomdp.errors import UserError, disk_error
from vd4rl_pomdp.runs import interrupt

COMMANDS |= {
    "demo": stages.DEMO,
    "list": parts.LIST,
    "data": data.COMMANDS,
    "hub": hub.COMMANDS,
    "policy": policy.COMMANDS,
    **stages.COMMANDS,
    "navigation": navigation.COMMANDS,
    "sweep": stages.SWEEP,
    **studies.COMMANDS,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vd4rl-pomdp`."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # \u2028 and the like for what a terminal cannot show
    try:
        _refuse_undecodable(words)
        with interrupt.handled(program=True):
            run_stage(words)
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except FloatingPointError as error:
        print(f"error: training diverged, {error}; lower --learning-rate or use --precision fp32", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt as error:
        _say_ended("interrupted", str(error))
        sys.exit(130)
    except interrupt.Terminated as error:
        _say_ended("terminated", error.reason)
        raise
    except BrokenPipeError:
        sys.exit(141)
    except OSError as error:
        print(f"error: {disk_error(error.filename, error)}", file=sys.stderr)
        sys.exit(2)


def _say_ended(how: str, kept: str) -> None:
    """One line for a signal's end; what was `kept` is where a training loop stood."""
    where = f"{kept}, and the same command goes on from there" if kept else "the same command does what is left"
    print(f"{how}: {where}", file=sys.stderr)


def _refuse_undecodable(words: Sequence[str]) -> None:
    """Names and paths go into files and pages, which are UTF-8."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UserError(f"{word!a} is not UTF-8: use another name") from None
