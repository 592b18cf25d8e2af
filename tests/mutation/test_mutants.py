"""The list of mutants matches the code; `python tools/mutants.py` runs them."""

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    return importlib.import_module("mutants")


def test_mutants_apply_once_and_name_existing_tests(script):
    mutants = script.load_mutants()
    assert len({mutant["name"] for mutant in mutants}) == len(mutants) > 59
    for mutant in mutants:
        text = script.mutated(mutant, ROOT)
        ast.parse(text)
        assert text != (ROOT / mutant["file"]).read_text(), mutant["name"]
        file, function = mutant["test"].split("::")
        assert re.search(rf"^def {function}\(", (ROOT / file).read_text(), re.MULTILINE), mutant["name"]


def test_mutants_script_reports_caught_and_surviving_mutants(script, tmp_path, monkeypatch, capsys):
    (tmp_path / "double.py").write_text("def double(x):\n    return 2 * x\n")
    (tmp_path / "test_it.py").write_text("from double import double\n\n\ndef test_two():\n    assert double(2) == 4\n")
    monkeypatch.setattr(script, "copy_tree", lambda tree: tmp_path.rename(tree))
    monkeypatch.setattr("sys.argv", ["mutants"])
    place = {"file": "double.py", "old": "2 * x", "test": "test_it.py::test_two"}
    mutants = [{"name": "wrong", "new": "3 * x", **place}, {"name": "same at 2", "new": "x ** 2", **place}]
    monkeypatch.setattr(script, "load_mutants", lambda: mutants)
    with pytest.raises(ValueError, match=r"wrong: its old text is in double.py 0 times, not once"):
        script.mutated(mutants[0] | {"old": "4 * x"}, tmp_path)
    assert script.main() == 1
    assert capsys.readouterr().out.splitlines() == ["1/2 caught: wrong", "2/2 SURVIVED: same at 2", "1 of 2 caught"]
