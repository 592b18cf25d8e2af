"""Every bad input ends in one line and exit code 2: try it, over all commands, all flags and all files.

    python tools/bad_input.py [--only NAME ...] [--every N] [--list]

A bad input is one thing wrong in an otherwise valid command line (`bad_input_flags`, generated from the commands'
config classes) or in one file that a command reads (`bad_input_files`, damaged by `bad_input_damage` in the valid files
of `bad_input_world`). Each runs in a process of its own, in a copy of those files, within limits of time and memory.
It passes if the exit code is 2, stderr is one line that begins with `error: `, and no file has changed, appeared or
gone. Single keys of JSON files are spoilt without knowing who reads them: there exit code 0 passes, too. A newest
checkpoint that is damaged beside a whole one must end in exit code 0 and one line of warning. What is no bad input
after all is listed with its reason (`FINE` in `bad_input_files`) and not tried.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import os
import resource
import shutil
import stat
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ |= {"HF_ENDPOINT": "http://127.0.0.1:9", "NO_PROXY": "127.0.0.1"}  # where nobody is: nothing is sent
sys.path.insert(0, str(Path(__file__).parent))

from bad_input_files import FINE, file_cases
from bad_input_flags import Case, flag_cases
from bad_input_world import build_world

from vd4rl_pomdp.cli import main as program

TIME_LIMIT_S = 120
SHARED = (
    "pretrain.train",
    "vd4rl_pomdp.studies.navigation.train",
    "finetune.train",
    "vd4rl_pomdp.report",
    "sklearn.cluster",
)
"""Modules that most cases import: once, in this process."""
ECHO = ("$ vd4rl-pomdp ", "vd4rl-pomdp ")
"""How the commands that run others announce one."""
MEMORY = 4 << 30
"""Address space that a case may take beyond what this process has."""


def main() -> None:
    """Run the cases that the arguments choose and print what failed and a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[""], help="cases whose name begins with one of these words")
    parser.add_argument("--every", type=int, default=1, help="of these, only one in so many")
    parser.add_argument("--list", action="store_true", help="print the cases' names only")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bad-input-") as folder:
        root = Path(folder)
        os.environ["VD4RL_POMDP_CACHE"] = str(root / "cache")
        make_world(root / "world")
        chosen_cases = [case for case in all_cases(root / "world") if title(case).startswith(tuple(chosen.only))]
        fine = [case for case in chosen_cases if reason(case)]
        cases = [case for case in chosen_cases if not reason(case)][:: chosen.every]
        if chosen.list:
            print(*map(title, cases), sep="\n")
            return
        failures = {}
        for number, case in enumerate(cases):
            if problem := try_case(case, root):
                failures[title(case)] = problem
                print(f"FAILED {title(case)}: {problem}", flush=True)
            elif sys.stderr.isatty():
                print(f"\r{number + 1}/{len(cases)}", end="", file=sys.stderr)
        print_table(cases, failures, fine)
    sys.exit(bool(failures))


def make_world(folder: Path) -> None:
    """Build the valid files in a child, so that this process never renders, and import what the cases share."""
    child = os.fork()
    if child == 0:
        with _ending():
            build_world(folder)
    assert os.waitpid(child, 0)[1] == 0, "the valid files could not be made"
    for module in SHARED:
        importlib.import_module(module)


def all_cases(world: Path) -> list[Case]:
    """Every case; that each pattern of FINE names some of them is checked."""
    cases = [*flag_cases(), *file_cases(world)]
    idle = [pattern for pattern in FINE if not any(fnmatchcase(title(case), pattern) for case in cases)]
    assert not idle, f"FINE names no case: {idle}"
    return cases


def reason(case: Case) -> str:
    """Why a case is no bad input, empty if it is one."""
    return next((why for pattern, why in FINE.items() if fnmatchcase(title(case), pattern)), "")


def title(case: Case) -> str:
    """A case's name: command, flag or file, kind of badness."""
    return f"{case.command} | {case.subject} | {case.kind}"


def try_case(case: Case, root: Path) -> str:
    """Run a case in a copy of `root/world`; what is wrong with its end, empty if nothing is."""
    folder = root / "case"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(root / "world", folder, symlinks=True, copy_function=_copy)
    with _inside(folder):
        if case.spoil is not None:
            case.spoil()
        before = _contents(folder)
        code, err = _run(case.words, root)
        after = _contents(folder)
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    if case.warns:
        return _problem_of_warning(code, err)
    return "" if case.may_pass and code == 0 else _problem(code, err, changed)


def _problem_of_warning(code: int, err: str) -> str:
    warnings = sum(line.startswith("warning: ") for line in err.splitlines())
    return "" if (code, warnings) == (0, 1) else f"exit code {code}, {warnings} warnings: {err[-300:]}"


def _problem(code: int, err: str, changed: list[str]) -> str:
    lines = err.strip().splitlines()
    last = lines[-1][:300] if lines else ""
    if code < 0:
        return f"ran for {TIME_LIMIT_S} s" if code == -9 else f"ended by signal {-code}: {last}"
    if code != 2:
        return f"exit code {code}: {last}"
    if [line for line in lines if not line.startswith(ECHO)] != [lines[-1]] or not last.startswith("error: "):
        return f"{len(lines)} lines: {' / '.join(lines)[:300]}"
    return f"changed {', '.join(changed)[:200]} ({last})" if changed else ""


def _run(words: list[str], root: Path) -> tuple[int, str]:
    """Exit code, or minus the signal, and stderr of `vd4rl-pomdp WORDS` in a child of this process."""
    sys.stdout.flush()
    with (root / "out").open("wb") as out, (root / "err").open("wb") as err:
        child = os.fork()
        if child == 0:
            _be_the_program(words, out.fileno(), err.fileno())
        return _wait(child), (root / "err").read_bytes().decode(errors="replace")


def _be_the_program(words: list[str], out: int, err: int) -> None:
    """Replace the streams, run the command line and end this process."""
    for number, target in ((os.open(os.devnull, os.O_RDONLY), 0), (out, 1), (err, 2)):
        os.dup2(number, target)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
    os.setpgid(0, 0)
    sys.argv = ["vd4rl-pomdp", *words]
    with _ending():
        program(words)


@contextmanager
def _ending() -> Iterator[None]:
    """End this process as the interpreter would, when the block ends."""
    code = 1
    try:
        yield
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _wait(child: int) -> int:
    limit = time.monotonic() + TIME_LIMIT_S
    while time.monotonic() < limit:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.killpg(child, 9)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _copy(source: str, target: str) -> None:
    """Copy a file; a pipe is made anew, for copying would wait for a writer."""
    if stat.S_ISFIFO(os.lstat(source).st_mode):
        os.mkfifo(target)
    else:
        shutil.copy2(source, target, follow_symlinks=False)


def _contents(folder: Path) -> dict[str, str]:
    """What every name below a folder stands for."""
    return {os.fsencode(p.relative_to(folder)).decode(errors="replace"): _stands_for(p) for p in folder.rglob("*")}


def _stands_for(path: Path) -> str:
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        return f"link to {os.readlink(path)}"
    if stat.S_ISREG(mode):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return oct(stat.S_IFMT(mode))


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def print_table(cases: list[Case], failures: dict[str, str], fine: list[Case]) -> None:
    """Tried, failed and not tried because they are fine, by command."""
    tried, left = (Counter(case.command for case in some) for some in (cases, fine))
    failed = Counter(case.command for case in cases if title(case) in failures)
    print(f"\n{'command':<20}tried  failed  fine")
    for name in sorted(tried | left):
        print(f"{name:<20}{tried[name]:>5}  {failed[name] or '':>6}  {left[name] or '':>4}")
    print(f"\n{len(cases)} bad inputs tried, {len(failures)} failed; {len(fine)} more are fine, see FINE")


if __name__ == "__main__":
    main()
