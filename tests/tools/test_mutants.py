"""The list of mutants, its page and the code stay together, and the script tells caught mutants from survivors."""

import ast
import importlib
import re
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def script(monkeypatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("mutants")


def test_every_mutant_still_applies_exactly_once_and_is_python(script):
    for mutant in script.load_mutants():
        text = mutant.apply(ROOT)
        ast.parse(text)
        assert text != (ROOT / mutant.file).read_text(), mutant.name


def test_every_mutant_has_its_own_name_and_tests_that_exist(script):
    mutants = script.load_mutants()
    assert len({mutant.name for mutant in mutants}) == len(mutants) > 38
    assert [test for mutant in mutants for test in mutant.tests if not script.is_test(test)] == []
    assert all(mutant.tests for mutant in mutants)


def test_the_page_has_a_row_for_each_mutant_and_names_a_test_that_caught_it(script):
    text = script.PAGE.read_text()
    lines = [line for line in text.splitlines() if re.match(r"\| (?!broken)", line)]
    verdicts = [line.rsplit(" | ", 1)[1].removesuffix(" |") for line in lines]
    assert script.page(list(zip(script.load_mutants(), verdicts, strict=True))) == text
    assert [verdict for verdict in verdicts if not script.is_test(verdict.strip("`"))] == []


def test_a_page_tells_what_it_was_made_of_but_for_tests_that_are_gone(script):
    here = "`tests/test_mutants.py::test_a_page_tells_what_it_was_made_of_but_for_tests_that_are_gone`"
    verdicts = {"a | b": here, "gone": "`tests/test_mutants.py::test_of_old`", "no": script.SURVIVED}
    mutants = [script.Mutant("Numbers", name, "x.py", "1", "2", "c | d", ()) for name in verdicts]
    page = script.page(list(zip(mutants, verdicts.values(), strict=True)))
    assert script.told(page) == {name: verdict for name, verdict in verdicts.items() if name != "gone"}


@pytest.fixture
def tree(tmp_path) -> Path:
    """A checkout of a single function with its test."""
    root = tmp_path / "checkout"
    (root / "tests").mkdir(parents=True)
    (root / "double.py").write_text("def double(x):\n    return 2 * x\n")
    (root / "tests" / "test_double.py").write_text(
        "from double import double\n\n\ndef test_two():\n    assert double(2) == 4\n"
    )
    (root / "tests" / "test_more.py").write_text(
        "import pytest\nfrom double import double\n\n\n"
        "@pytest.mark.parametrize('x', [3])\ndef test_three(x):\n    assert double(x) == 6\n"
    )
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    return root


@pytest.mark.parametrize(
    ("new", "whole_suite", "verdict"),
    [
        ("3 * x", False, "`tests/test_double.py::test_two`"),
        ("x ** 2", False, "**survived**"),
        ("x ** 2", True, "`tests/test_more.py::test_three`"),
    ],
)
def test_mutants_are_tried_in_a_copy_and_named_with_what_caught_them(script, tree, new, whole_suite, verdict):
    before = (tree / "double.py").read_text()
    mutant = script.Mutant("Numbers", "wrong", "double.py", "2 * x", new, "it doubles", ("tests/test_double.py",))
    assert script.try_mutant(tree, mutant, 300, whole_suite) == verdict
    assert (tree / "double.py").read_text() == before
    assert script.row(mutant, verdict) == f"| wrong | it doubles | {verdict} |"


def test_a_mutant_that_never_ends_and_one_that_no_longer_applies_are_named(script, tree):
    place = ("Numbers", "wrong", "double.py")
    endless = script.Mutant(
        *place, "return", "while x:\n        x = 2\n    return", "it ends", ("tests/test_double.py",)
    )
    assert script.try_mutant(tree, endless, 2, False) == "the time limit of 2 s"
    for old, count in (("4 * x", 0), ("x", 2)):
        with pytest.raises(ValueError, match=rf"'wrong': its old text is in double\.py {count} times, not once"):
            script.Mutant(*place, old, "3 * x", "it doubles", ()).apply(tree)


def test_tests_that_cannot_be_run_are_no_verdict(script, tree):
    mutant = script.Mutant("Numbers", "wrong", "double.py", "2 * x", "3 * x", "it doubles", ("tests/test_nothing.py",))
    with pytest.raises(ValueError, match="pytest could not run these tests"):
        script.try_mutant(tree, mutant, 300, False)
