"""The command line: one function per command. Bad input ends with one line and exit code 2, never with a traceback."""

from __future__ import annotations

import importlib
import io
import multiprocessing
import os
import re
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from vd4rl_pomdp import __version__
from vd4rl_pomdp.core.errors import OutOfMemoryError, UserError, disk_error, in_one_line
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.sweeps.options import JOB_VARIABLE

PROGRAM = "vd4rl-pomdp"
COMMANDS = {
    "demo": ("demo.demo", "every stage on a small set, in minutes"),
    "list": ("stages.list_parts", "all parts that have a name: methods, corruptions, algorithms and the like"),
    "data collect": ("data.collect", "render a set in V-D4RL's format from the shipped actors"),
    "data download": ("data.download", "fetch a published V-D4RL set"),
    "data import": ("data.import_set", "a set of another format, such as Minari's, as one of this package's"),
    "data export": ("data.export_set", "a set in another format"),
    "data card": ("data.card", "describe a set: returns, origin, film strip"),
    "data view": ("data.view", "a page to browse a set's episodes, clean and corrupted"),
    "data check": ("data.check", "validate a set and replay its actions"),
    "data parity": ("data.parity", "compare rendered pixels with the data's"),
    "agents export": ("hub.export", "a fine-tuned run's encoder and policy as one small folder"),
    "agents play": ("hub.play", "the same episodes by several agents: returns, and a film side by side"),
    "hub push": ("hub.push", "write an encoder, an agent or a dataset to the Hugging Face Hub"),
    "hub pull": ("hub.pull", "fetch and check what was pushed"),
    "pretrain": ("stages.pretrain", "train an encoder"),
    "finetune": ("stages.finetune", "train a policy on a frozen encoder, by TD3+BC or another algorithm"),
    "evaluate": ("stages.evaluate", "evaluate a fine-tuned run again"),
    "certify": ("studies.certify", "whether a set under a corruption needs a memory of what was seen"),
    "navigation collect": ("studies.navigation_collect", "a maze's data, with true states"),
    "navigation train": ("studies.navigation_train", "an objective on a maze, beside a state probe"),
    "navigation policy": ("studies.navigation_policy", "train the first-person policy (PPO) that ships"),
    "navigation report": ("studies.navigation_report", "the paper's tables and figures about runs"),
    "sweep run": ("sweeps.run", "carry out a grid, or resume it"),
    "sweep status": ("sweeps.show_status", "counts, rate, time left and failures of a sweep"),
    "sweep retry": ("sweeps.retry", "run failures again"),
    "sweep join": ("sweeps.join", "help with a sweep on this machine"),
    "sweep list": ("sweeps.list_grids", "the grids that ship"),
    "report": ("studies.report", "an HTML page, tables and figures about runs"),
    "report compare": ("studies.compare", "two result sets side by side"),
    "results add": ("studies.add", "append finished runs to a results folder"),
    "results verify": ("studies.verify", "check rows against their own records, and replay an episode"),
    "theory": ("studies.theory", "the paper's claims on finite worlds, by enumeration"),
    "bench": ("studies.bench", "speed and memory on this machine"),
}
"""Function (within this package) and summary of every command. A function takes the words after its name, and the
program name. Its module is imported on call: imports can take seconds (torch), and listing commands needs none.
"""


@dataclass(frozen=True)
class End:
    """How a command ended."""

    code: int = 0
    line: str = ""
    """Message for the user; empty for none."""


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
    if end.line:
        print(end.line, file=sys.stderr)
    if end.code:
        sys.exit(end.code)


def run_to_end(words: Sequence[str]) -> End:
    """Run `vd4rl-pomdp WORDS`; only bugs raise."""
    second = signal.SIG_IGN if JOB_VARIABLE in os.environ else signal.SIG_DFL  # the sweep driver terminates its jobs
    try:
        for word in words:
            word.encode()  # names and paths are written to UTF-8 files
        with interrupt.handled(second):
            name = next((n for n in (" ".join(words[:2]), *words[:1]) if n in COMMANDS), None)
            if name is None:
                _show_commands(list(words))
            else:
                module, _, function = COMMANDS[name][0].partition(".")
                command = getattr(importlib.import_module(f"{__name__}.{module}"), function)
                command(list(words[len(name.split()) :]), f"{PROGRAM} {name}")
    except UserError as error:
        return End(error.code, f"error: {in_one_line(error)}")
    except UnicodeEncodeError as error:
        return End(2, f"error: {error.object!a} is not UTF-8: use another name")
    except FloatingPointError as error:
        return End(1, f"error: training diverged, {error}; lower --learning-rate or use fp32")
    except KeyboardInterrupt as error:
        return End(130, _resume("interrupted", str(error)))
    except interrupt.Terminated as error:
        return End(143, _resume("terminated", error.reason))
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        return End(141)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not _NO_MEMORY.search(str(error)):
            raise
        line = f"error: out of memory ({in_one_line(error)[:200]}); lower --batch-size, or what else sets the size"
        return End(OutOfMemoryError.code, line)
    except OSError as error:
        told = disk_error(error.filename, error)
        return End(told.code, f"error: {told}")
    return End()


def _resume(how: str, kept: str) -> str:
    """Message after a signal; `kept` says where training stopped."""
    return f"{how}: {kept + '; ' if kept else ''}re-run the same command to resume"


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
    print(f"usage: {' '.join([PROGRAM, *group])} COMMAND [--flags]   (COMMAND --help says more)\n")
    for name, summary in listed.items():
        print(f"  {name:<{max(map(len, listed))}}  {summary}")
