"""Put errors into a copy of the tree, one at a time, and see whether the test named for each fails.

    python tools/mutants.py              all of tests/mutation/mutants.toml
    python tools/mutants.py iql k-means  those whose name or file contains one of these words

First the named tests must pass without an error. Exit code 1 if one of them does not, or a mutant survives.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import h5py  # noqa: F401 - this and the next are loaded once, for all runs of pytest
import pytest
import sklearn.cluster
import sklearn.linear_model  # noqa: F401
import torch

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "tests" / "mutation" / "mutants.toml"
LIMIT_S = 600


def load_mutants() -> list[dict[str, str]]:
    """All mutants in order, each with name, file, old, new, claim and test."""
    return [mutant for section in tomllib.loads(LIST.read_text(encoding="utf-8")).values() for mutant in section]


def mutated(mutant: dict[str, str], tree: Path) -> str:
    """Text of a mutant's file with its error; raises ValueError if the old text is not there exactly once."""
    text = (tree / mutant["file"]).read_text(encoding="utf-8")
    if (count := text.count(mutant["old"])) != 1:
        raise ValueError(f"{mutant['name']}: its old text is in {mutant['file']} {count} times, not once")
    return text.replace(mutant["old"], mutant["new"])


def copy_tree(target: Path) -> None:
    """Copy all files of the checkout but those that git ignores."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(words, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            (target / name).write_bytes((ROOT / name).read_bytes())


def run_tests(tree: Path, tests: list[str]) -> int | None:
    """Pytest's exit code in a process of its own, None beyond the time limit."""
    process = multiprocessing.get_context("fork").Process(target=_pytest, args=(tree, tests))
    process.start()
    process.join(LIMIT_S * len(tests))
    code = process.exitcode
    process.kill()
    return code


def _pytest(tree: Path, tests: list[str]) -> None:
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": str(tree), "VD4RL_POMDP_CACHE": f"{tree}-cache"}
    sys.path[:] = [str(tree), *(path for path in sys.path if Path(path).resolve() not in (ROOT, ROOT / "tools"))]
    with open(f"{tree}.log", "a") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", f"--basetemp={tree}-tests", *tests]))


def main() -> int:
    """Try the mutants that the words choose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", default=[""], help="parts of names or files; none: all mutants")
    words = [word.lower() for word in parser.parse_args().words]
    mutants = [m for m in load_mutants() if any(word in f"{m['name']} {m['file']}".lower() for word in words)]
    if not mutants:
        parser.error(f"no mutant is called {' or '.join(words)}")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        tree, survivors = Path(scratch, "tree"), 0
        copy_tree(tree)
        if run_tests(tree, sorted({m["test"] for m in mutants})) != 0:
            print(Path(f"{tree}.log").read_text()[-2000:], "\nthe tests fail without a mutant, too")
            return 1
        for number, mutant in enumerate(mutants, 1):
            path, text = tree / mutant["file"], mutated(mutant, tree)
            whole = path.read_bytes()
            path.write_text(text, encoding="utf-8")
            caught = run_tests(tree, [mutant["test"]]) in (1, None)
            path.write_bytes(whole)
            survivors += not caught
            print(f"{number}/{len(mutants)} {'caught' if caught else 'SURVIVED'}: {mutant['name']}", flush=True)
        print(f"{len(mutants) - survivors} of {len(mutants)} caught")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main())
