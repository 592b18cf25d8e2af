"""Public classes and type aliases have unique names in the project."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("vd4rl_pomdp", "pretrain", "finetune", "baselines")


def definitions(source: str) -> set[str]:
    """Public classes and type aliases that a module defines."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return {name for name in found if name[0].isupper() and not name.isupper()}


def test_definitions_are_classes_and_aliases():
    source = "class Aa: pass\nBb = dict[str, int]\nCc = int | None\nDd = Ee\nFF = a | b\n_Hh = list[int]\nii = x[0]\n"
    assert definitions(source) == {"Aa", "Bb", "Cc", "Dd"}


def test_public_names_are_unique():
    places = defaultdict(list)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for name in definitions(path.read_text(encoding="utf-8")):
                places[name].append(path.relative_to(ROOT).as_posix())
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
