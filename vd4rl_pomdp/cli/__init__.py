"""The command line: one subcommand a stage. Bad input ends with one line and exit code 2, never with a traceback."""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence

if os.name != "posix":
    print("error: vd4rl-pomdp runs on Linux and macOS; on Windows use its subsystem for Linux (WSL)", file=sys.stderr)
    sys.exit(2)

from vd4rl_pomdp.cli import data, hub, navigation, parts, policy, stages, studies, sweeps
from vd4rl_pomdp.cli.dispatch import COMMANDS
from vd4rl_pomdp.cli.ends import run_to_end
from vd4rl_pomdp.sweeps.own_file import JOB_VARIABLE

COMMANDS |= {
    "demo": stages.DEMO,
    "list": parts.LIST,
    "data": data.COMMANDS,
    "hub": hub.COMMANDS,
    "policy": policy.COMMANDS,
    **stages.COMMANDS,
    "navigation": navigation.COMMANDS,
    "sweep": sweeps.COMMANDS,
    **studies.COMMANDS,
}
_UNGUARDED = (
    "error: processes that help import the file that was started, which calls main() then, too: put that call below "
    'if __name__ == "__main__":'
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vd4rl-pomdp`."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # which a worker is while it imports its file
        print(_UNGUARDED, file=sys.stderr)
        sys.exit(2)
    words = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # \u2028 and the like for what a terminal cannot show
    end = run_to_end(words, signal.SIG_IGN if JOB_VARIABLE in os.environ else signal.SIG_DFL)
    if end.line:
        print(end.line, file=sys.stderr)
    if end.code:
        sys.exit(end.code)
