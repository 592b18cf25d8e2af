"""The command line: one function per command. Bad input ends with one line and exit code 2, never with a traceback."""

from __future__ import annotations

import os
import sys

if os.name == "nt":  # before the imports that fail there
    print("error: Windows is not supported: use WSL", file=sys.stderr)
    sys.exit(2)

import importlib
import io
import multiprocessing
import re
import signal
from collections.abc import Sequence
from typing import NamedTuple, TextIO

from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import OutOfMemoryError, UserError, disk_error, in_one_line
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.options import JOB_VARIABLE

PROGRAM = "vd4rl-pomdp"
COMMANDS = {
    "demo": ("demo.demo", "run every stage on small datasets, in minutes"),
    "list": ("stages.list_parts", "list methods, corruptions, algorithms and other plug-ins"),
    "data collect": ("data.collect", "collect a dataset in V-D4RL's format with the shipped actors"),
    "data download": ("data.download", "download V-D4RL's published datasets"),
    "data import": ("data.import_set", "convert a dataset from Minari, LeRobot or another format"),
    "data export": ("data.export_set", "convert a dataset to another format"),
    "data card": ("data.card", "write a dataset's card: returns, origin, film strip"),
    "data view": ("data.view", "write an HTML page to browse a dataset, clean and corrupted"),
    "data check": ("data.check", "validate a dataset and replay its actions"),
    "data parity": ("data.parity", "compare rendered pixels with the dataset's"),
    "agents export": ("hub.export", "save a run's encoder and policy as one small folder"),
    "agents play": ("hub.play", "compare agents on the same episodes: returns, and a film side by side"),
    "hub push": ("hub.push", "upload an encoder, agent or dataset to the Hugging Face Hub"),
    "hub pull": ("hub.pull", "download and verify what was pushed"),
    "pretrain": ("stages.pretrain", "train an encoder"),
    "finetune": ("stages.finetune", "train a policy on a frozen encoder, by TD3+BC or another algorithm"),
    "evaluate": ("stages.evaluate", "evaluate a fine-tuned run again"),
    "certify": ("studies.certify", "test whether a dataset under a corruption needs memory"),
    "navigation collect": ("navigation.collect", "collect a maze dataset, with true states"),
    "navigation train": ("navigation.train", "train an objective and a state probe on a maze"),
    "navigation policy": ("navigation.policy", "train the first-person data policy (PPO)"),
    "navigation report": ("navigation.report", "write the paper's maze tables and figures from runs"),
    "sweep run": ("sweeps.run", "run or resume a grid of experiments"),
    "sweep status": ("sweeps.show_status", "show a sweep's progress, time left and failures"),
    "sweep retry": ("sweeps.retry", "retry failed runs"),
    "sweep join": ("sweeps.join", "work on a running sweep from this machine"),
    "sweep list": ("sweeps.list_grids", "list the built-in grids"),
    "report": ("report.report", "write an HTML report, tables and figures from runs"),
    "report compare": ("report.compare", "compare two sets of results"),
    "results add": ("report.add", "append finished runs to a results folder"),
    "results verify": ("report.verify", "check a results folder for consistency, and replay an episode"),
    "theory": ("studies.theory", "check the paper's claims on finite worlds, by enumeration"),
    "bench": ("studies.bench", "measure speed and memory on this machine"),
}
"""Function (within this package) and summary of every command. A function takes the words after its name, and the
program name. Its module is imported on call: imports can take seconds (torch), and listing commands needs none. For
their `--help` to need none either, functions import what loads torch.
"""


class End(NamedTuple):
    """How a command ended: exit code, and a message for the user, empty for none."""

    code: int = 0
    line: str = ""


_NO_MEMORY = re.compile("out of memory|allocate memory|Storage size calculation overflowed|ALLOC_FAILED")
"""Out-of-memory messages of torch, on a CPU and from GPU libraries."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vd4rl-pomdp`."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker process that imports its main file
        print(
            'error: worker processes import this file: call main() below `if __name__ == "__main__":`', file=sys.stderr
        )
        sys.exit(2)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # e.g. \u2028, which a terminal may not show
    end = run_to_end(sys.argv[1:] if arguments is None else arguments)
    try:
        print(end.line, end="\n" * bool(end.line), file=sys.stderr, flush=True)
    except OSError:  # e.g. a job's log on a full disk; only the exit code reaches the sweep
        _discard(sys.stderr)
    if end.code:
        sys.exit(end.code)


def run_to_end(words: Sequence[str]) -> End:
    """Run `vd4rl-pomdp WORDS`; only bugs raise."""
    second = signal.SIG_IGN if JOB_VARIABLE in os.environ else signal.SIG_DFL  # the sweep driver terminates its jobs
    try:
        for word in words:
            word.encode()  # names and paths are written to UTF-8 files
        with interrupt.handled(second):
            try:
                _run(list(words))
            finally:
                failure = sys.exception()
                try:
                    if sys.stdout is not None:  # it may have been closed
                        sys.stdout.flush()  # here, where a closed pipe is handled; --help ends in SystemExit
                except OSError as error:
                    _discard(sys.stdout)
                    if failure is None or isinstance(error, BrokenPipeError):  # else a full disk is no news
                        raise
    except UserError as error:
        return End(error.code, f"error: {in_one_line(error)}")
    except UnicodeEncodeError as error:
        return End(2, f"error: {error.object!a} is not UTF-8: use another name")
    except FloatingPointError as error:
        return End(1, f"error: training diverged, {error}; lower --learning-rate or use fp32")
    except (KeyboardInterrupt, interrupt.Terminated) as error:  # the message says where training stopped
        code, how = (130, "interrupted") if isinstance(error, KeyboardInterrupt) else (143, "terminated")
        where = getattr(error, "reason", str(error))
        return End(code, f"{how}: {where}{'; ' if where else ''}re-run the same command to resume")
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        return End(141)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not _NO_MEMORY.search(str(error)):
            raise
        line = f"error: out of memory ({in_one_line(error)[:200]}); lower --batch-size, or what else sets the size"
        return End(OutOfMemoryError.code, line)
    except OSError as error:
        named = disk_error(error.filename, error)
        return End(named.code, f"error: {named}")
    return End()


def _discard(stream: TextIO) -> None:
    """Discard what a stream could not write. Python flushes it once more at its end, and would change the exit code."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _run(words: list[str]) -> None:
    name = next((n for n in (" ".join(words[:2]), *words[:1]) if n in COMMANDS), None)
    if name is None:
        _show_commands(words)
    else:
        module, _, function = COMMANDS[name][0].partition(".")
        command = getattr(importlib.import_module(f"{__name__}.{module}"), function)
        command(words[len(name.split()) :], f"{PROGRAM} {name}")


def _show_commands(words: list[str]) -> None:
    """Print all commands, or those of a group; UserError for an unknown word."""
    if words[:1] == ["--version"]:
        print(__version__)
        return
    group = [] if not words or words[0].startswith("-") else words[:1]
    listed = {n: summary for n, (_, summary) in COMMANDS.items() if n.split()[: len(group)] == group}
    if not listed or (group and len(words) > 1 and not words[1].startswith("-")):
        choices = [n.split()[-1] for n in listed] or dict.fromkeys(n.split()[0] for n in COMMANDS)
        raise UserError(f"unknown command '{' '.join([PROGRAM, *words[:2]])}': choose one of {', '.join(choices)}")
    print(f"usage: {' '.join([PROGRAM, *group])} COMMAND [--flags]   (COMMAND --help for details)\n")
    for name, summary in listed.items():
        print(f"  {name:<{max(map(len, listed))}}  {summary}")
