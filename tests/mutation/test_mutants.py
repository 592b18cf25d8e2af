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
