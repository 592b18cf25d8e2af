"""Mutation tests: insert errors into a copy of the tree, one at a time, and check that each one's test fails.

    python tools/mutants.py              all of tests/mutation/mutants.toml
    python tools/mutants.py iql k-means  those whose name or file contains one of these words

The tests must pass without an error first. Exit code 1 if one of them fails, or if a mutant survives.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import tomllib
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "tests" / "mutation" / "mutants.toml"
LIMIT_S = 600


def load_mutants() -> list[dict[str, str]]:
    """All mutants in order, each with name, file, old, new and test."""
    return [mutant for section in tomllib.loads(LIST.read_text(encoding="utf-8")).values() for mutant in section]


def mutated(mutant: dict[str, str], tree: Path) -> str:
    """Text of a mutant's file with its error; ValueError unless the old text occurs exactly once."""
    text = (tree / mutant["file"]).read_text(encoding="utf-8")
    if (count := text.count(mutant["old"])) != 1:
        raise ValueError(f"{mutant['name']}: its old text is in {mutant['file']} {count} times, not once")
    return text.replace(mutant["old"], mutant["new"])


def copy_tree(target: Path) -> None:
    """Copy all files of the checkout that git does not ignore."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(words, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            (target / name).write_bytes((ROOT / name).read_bytes())


def run_tests(tree: Path, tests: list[str]) -> int:
    """Pytest's exit code; a timeout counts as a failure."""
    env = os.environ | {"PYTHONPATH": str(tree)}
    env["PYTHONDONTWRITEBYTECODE"] = "1"  # bytecode is taken for that of a mutant of equal size in the same second
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"--basetemp={tree}-tests", *tests]
    with suppress(subprocess.TimeoutExpired), open(f"{tree}.log", "a") as log:
        return subprocess.run(words, cwd=tree, env=env, stdout=log, stderr=log, timeout=LIMIT_S * len(tests)).returncode
    return 1


def main() -> int:
    """Run the mutants selected on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", default=[""], help="parts of names or files; none: all mutants")
    words = [word.lower() for word in parser.parse_args().words]
    mutants = [m for m in load_mutants() if any(word in f"{m['name']} {m['file']}".lower() for word in words)]
    if not mutants:
        parser.error(f"no mutant is called {' or '.join(words)}")
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
            caught = run_tests(tree, [mutant["test"]]) == 1
            path.write_bytes(whole)
            survivors += not caught
            print(f"{number}/{len(mutants)} {'caught' if caught else 'SURVIVED'}: {mutant['name']}", flush=True)
        print(f"{len(mutants) - survivors} of {len(mutants)} caught")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main())
