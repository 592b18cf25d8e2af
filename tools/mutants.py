"""Break the code on purpose, one claim at a time, and see which test notices.

    python tools/mutants.py                      all of them; writes docs/mutants.md
    python tools/mutants.py --only td3 k-means   those whose name, file or section contains a word
    python tools/mutants.py --new                those without a row on the page, or whose test is gone
    python tools/mutants.py --whole-suite        survivors of the tests named for them meet all the others, too

A mutant is one edit of one file, listed in mutants.toml with the claim that it breaks and the tests that should notice,
the fastest first. Each is tried in a copy of the tree; the checkout itself is never touched. Rows of mutants that are
not tried stay on the page. A survivor deserves a test of its claim.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_name("mutants.toml")
PAGE = ROOT / "docs" / "mutants.md"
SURVIVED = "**survived**"
_HEAD = """# Mutants

What the tests are worth: each row is one error put into the code on purpose, the claim that it breaks, and the test
that noticed it first. `python tools/mutants.py` tries them all anew, each in a copy of the tree, and writes this
page; the edits are in [`tools/mutants.toml`](../scripts/mutants.toml), and a test keeps page, list and code together.
"""
_LIBRARIES = ("torch", "sklearn.cluster", "sklearn.linear_model", "h5py", "gymnasium", "mujoco", "matplotlib", "pytest")
"""Imported once for all runs of pytest; nothing of the project may be among them."""
_CONTEXT = multiprocessing.get_context("forkserver")
_COLUMNS = "| broken | the claim | caught by |\n|---|---|---|"


@dataclass(frozen=True)
class Mutant:
    """One edit that a test should notice."""

    section: str
    name: str
    """What is broken, in words."""
    file: str
    old: str
    """Occurs in the file exactly once."""
    new: str
    claim: str
    """What is no longer true."""
    tests: tuple[str, ...]
    """Test files, or tests in them, fastest first."""

    @property
    def words(self) -> str:
        """What `--only` looks into."""
        return f"{self.section} {self.name} {self.file}".lower()

    def apply(self, tree: Path) -> str:
        """Text of its file with the edit; raises ValueError if the old text is not there exactly once."""
        text = (tree / self.file).read_text(encoding="utf-8")
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"{LIST.name}: {self.name!r}: its old text is in {self.file} {count} times, not once")
        return text.replace(self.old, self.new)


def load_mutants(path: Path = LIST) -> list[Mutant]:
    """All mutants, in order."""
    sections = tomllib.loads(path.read_text(encoding="utf-8"))
    return [
        Mutant(section, **(entry | {"tests": tuple(entry["tests"])}))
        for section, entries in sections.items()
        for entry in entries
    ]


def copy_tree(root: Path, target: Path) -> None:
    """Copy all files of a checkout but those that git ignores."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=root,
        capture_output=True,
        check=True,
    )
    for name in listed.stdout.decode().split("\0"):
        if name and (root / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            (target / name).write_bytes((root / name).read_bytes())


def first_failure(root: Path, edits: dict[str, str], tests: tuple[str, ...], limit: float) -> str:
    """The first test that fails in a copy of the tree with some files' texts exchanged; empty if none does.

    Raises:
        ValueError: pytest could not run the tests.
    """
    with tempfile.TemporaryDirectory() as scratch:
        tree, log = Path(scratch, "tree"), Path(scratch, "log")
        copy_tree(root, tree)
        for name, text in edits.items():
            (tree / name).write_text(text, encoding="utf-8")
        words = ["-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", f"--basetemp={scratch}/pytest", *tests]
        process = _CONTEXT.Process(target=_run_pytest, args=(words, tree, log))
        process.start()
        process.join(limit)
        if process.exitcode is None:
            _kill(process)
            return f"the time limit of {limit:g} s"
        return _read_failure(log.read_text(encoding="utf-8"), process.exitcode)


def _run_pytest(words: list[str], tree: Path, log: Path) -> NoReturn:
    """Become pytest in a tree; whatever it or its children print goes to a file."""
    os.setsid()
    os.chdir(tree)
    settings = {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", "VD4RL_POMDP_CACHE": f"{tree}-cache"}
    os.environ |= settings
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(tree))
    with log.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    import pytest

    code = int(pytest.main(words))
    sys.stdout.flush()
    os._exit(code)


def _kill(process: Any) -> None:
    """End a run of pytest with all that it has started."""
    with suppress(ProcessLookupError):  # it may not have come to lead a group of its own
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()


def _read_failure(output: str, code: int) -> str:
    failed = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+)", output, re.MULTILINE)
    if code not in (0, 1, 2) or bool(code) != bool(failed):
        raise ValueError(f"pytest could not run these tests:\n{output[-2000:]}")
    return f"`{failed[1]}`" if failed else ""


def try_mutant(root: Path, mutant: Mutant, limit: float, whole_suite: bool) -> str:
    """What caught a mutant, or SURVIVED."""
    edits = {mutant.file: mutant.apply(root)}
    found = first_failure(root, edits, mutant.tests, limit)
    if not found and whole_suite:
        found = first_failure(root, edits, ("tests", "--deselect=tests/test_mutants.py"), limit)
    return found or SURVIVED


def row(mutant: Mutant, verdict: str) -> str:
    """A line of the table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in (mutant.name, mutant.claim, verdict)) + " |"


def page(tried: list[tuple[Mutant, str]]) -> str:
    """The whole page."""
    caught = sum(verdict != SURVIVED for _, verdict in tried)
    lines = [_HEAD, f"{caught} of {len(tried)} are caught."]
    for section in dict.fromkeys(mutant.section for mutant, _ in tried):
        lines += ["", f"## {section}", "", _COLUMNS]
        lines += [row(mutant, verdict) for mutant, verdict in tried if mutant.section == section]
    return "\n".join(lines) + "\n"


def told(text: str) -> dict[str, str]:
    """Verdicts by name, as a page tells them; only such whose test is still there."""
    cells = [line[2:-2].split(" | ") for line in text.splitlines() if re.match(r"\| (?!broken)", line)]
    return {
        name.replace("\\|", "|"): verdict
        for name, _, verdict in cells
        if verdict == SURVIVED or is_test(verdict.strip("`"))
    }


def is_test(name: str) -> bool:
    """Whether `file`, `file::function` or `file::function[case]` is a test."""
    file, _, function = name.partition("::")
    path, wanted = ROOT / file, f"def {function.partition('[')[0]}(" if function else "def "
    return path.is_file() and wanted in path.read_text(encoding="utf-8")


def _tried(mutants: list[Mutant], limit: float, whole_suite: bool) -> Iterator[tuple[Mutant, str]]:
    """Try all, after the unchanged tree has passed their tests."""
    if not mutants:
        return
    for mutant in mutants:
        mutant.apply(ROOT)
    named = tuple(dict.fromkeys(test for mutant in mutants for test in mutant.tests))
    if failed := first_failure(ROOT, {}, named, limit * len(mutants)):
        raise ValueError(f"the unchanged tree fails {failed}: mend that first")
    for number, mutant in enumerate(mutants, 1):
        verdict = try_mutant(ROOT, mutant, limit, whole_suite)
        print(f"{number}/{len(mutants)} {mutant.name}: {verdict}", file=sys.stderr, flush=True)
        yield mutant, verdict


def main() -> int:
    """Try mutants; exit code 1 if one survives, 2 if one cannot be tried."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="try those that contain one of these words"
    )
    parser.add_argument("--new", action="store_true", help="try those without a row on the page, or whose test is gone")
    parser.add_argument("--whole-suite", action="store_true", help="let survivors meet all tests")
    parser.add_argument("--limit", type=float, default=600, help="seconds for one run of pytest")
    words = parser.parse_args()
    for name, value in (("MUJOCO_GL", "egl"), ("OMP_NUM_THREADS", "1"), ("LP_NUM_THREADS", "1")):
        os.environ.setdefault(name, value)
    _CONTEXT.set_forkserver_preload(list(_LIBRARIES))
    listed, kept = load_mutants(), told(PAGE.read_text(encoding="utf-8")) if PAGE.exists() else {}
    chosen = [
        mutant
        for mutant in listed
        if not (words.new and mutant.name in kept)
        and (not words.only or any(word.lower() in mutant.words for word in words.only))
    ]
    try:
        tried = list(_tried(chosen, words.limit, words.whole_suite))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    verdicts = kept | {mutant.name: verdict for mutant, verdict in tried}
    PAGE.write_text(page([(m, verdicts[m.name]) for m in listed if m.name in verdicts]), encoding="utf-8")
    return int(any(verdict == SURVIVED for _, verdict in tried))


if __name__ == "__main__":
    sys.exit(main())
