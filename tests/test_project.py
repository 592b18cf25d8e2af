"""Layout, dependencies and documentation, checked on the tracked files."""

import ast
import re
import shutil
import subprocess
import tomllib
from dataclasses import fields
from graphlib import TopologicalSorter
from importlib.metadata import requires
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from finetune.algorithms import ALGORITHMS
from finetune.config import FinetuneConfig
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from tests.helpers_stages import option_names
from tests.helpers_wheel import build_wheel
from vd4rl_pomdp.cli import COMMANDS, main
from vd4rl_pomdp.studies.navigation.config import NavigationConfig

ROOT = Path(__file__).parents[1]
PACKAGES = ("vd4rl_pomdp", "pretrain", "finetune", "baselines")
PACKAGE, OURS = ROOT / "vd4rl_pomdp", "vd4rl_pomdp."
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
ROOF = ("cli", "sweeps", "studies", "theory", "testing", "bench", "hub")
"""Subpackages of vd4rl_pomdp that may import everything; the stages and other subpackages import none of them."""
MAY_IMPORT = {
    "baselines": {"baselines"},
    "pretrain": {"pretrain", "baselines"},
    "finetune": {"finetune"},
    "ground": set(),
}
"""Packages that each package may import, besides the ground."""
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def everywhere(tree: ast.AST) -> set[str]:
    """Names of all modules that a module imports, including late imports."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def room(module: str) -> str:
    """The package of a module; roof or ground within vd4rl_pomdp."""
    package, _, rest = module.partition(".")
    return package if package != "vd4rl_pomdp" else "roof" if rest.split(".")[0] in ROOF else "ground"


def test_lower_layers_do_not_import_upper_ones():
    wrong = []
    for path in SOURCES:
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        others = {
            room(module) for module in everywhere(ast.parse(path.read_text())) if module.split(".")[0] in PACKAGES
        }
        if room(name) != "roof" and not name.endswith("__main__"):
            wrong += [f"{name} imports {other}" for other in others - MAY_IMPORT[room(name)] - {"ground"}]
    assert wrong == []


def test_sources_do_not_import_test_packages():
    trees = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in SOURCES}
    named = {name: {module.split(".")[0] for module in everywhere(tree)} for name, tree in trees.items()}
    assert [name for name in named if named[name] & {"pytest", "_pytest", "hypothesis", "tests"}] == []


def test_only_rendering_module_imports_mujoco():
    imported = {path: everywhere(ast.parse(path.read_text())) for path in [*SOURCES, *(ROOT / "tests").rglob("*.py")]}
    loading = {
        path.relative_to(ROOT).as_posix()
        for path, names in imported.items()
        if {name.split(".")[0] for name in names} & {"dm_control", "mujoco"}
    }
    envs = "vd4rl_pomdp/envs"
    assert loading - {f"{envs}/maze_renderers.py"} == {f"{envs}/rendering.py"}  # the former imports the latter


def test_imports_are_acyclic():
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in SOURCES}
    graph = {}
    for module, path in modules.items():
        names = everywhere(ast.parse(path.read_text()))
        imported = {name if name in modules else name.rpartition(".")[0] for name in names}
        graph[module] = imported & modules.keys() - {module}
    TopologicalSorter(graph).prepare()  # raises with the cycle


def test_sources_use_no_pickle_or_eval():
    forbidden = re.compile(
        r"\bimport pickle|torch\.load\((?!.*weights_only=True)|allow_pickle=True|(?<!\.)\beval\(|\bexec\("
    )
    assert [p for p in SOURCES if forbidden.search(p.read_text())] == []


def _names_no_encoding(call: ast.Call) -> bool:
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    if name not in ("open", "read_text", "write_text") or ast.unparse(call.func) in (
        "Image.open",
        "archive.open",
        "os.open",
        "av.open",
    ):
        return False
    words = [node.value for a in call.args for node in ast.walk(a) if isinstance(node, ast.Constant)]
    binary = any(isinstance(word, str) and "b" in word and set(word) <= set("abrwx+") for word in words)
    return (
        not binary
        and not {k.arg for k in call.keywords} & {"encoding", None}
        and ast.unparse(call.func) != "write_text"
    )


def test_text_files_are_opened_as_utf8():
    calls = [
        f"{path.relative_to(ROOT).as_posix()}:{node.lineno}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and _names_no_encoding(node)
    ]
    assert calls == []


def test_constraints_pin_dependencies_within_bounds():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}
    assert all("+" not in line and "/" not in line and line.count("==") == 1 for line in lines), "builds or hosts"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [entry for group in project["optional-dependencies"].values() for entry in group]
    assert [entry for entry in project["dependencies"] + extras if "<" not in entry] == [], "unbounded above"
    wanted = [Requirement(entry) for entry in project["dependencies"] + extras]
    assert [str(r) for r in wanted if pins.get(canonicalize_name(r.name), "none") not in r.specifier] == []


def test_dependencies_of_dm_control_are_required():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ours = [Requirement(entry) for entry in project["dependencies"]]
    newest = {canonicalize_name(r.name) for r in ours if not r.marker or r.marker.evaluate({"python_version": "3.13"})}
    theirs = [Requirement(entry) for entry in requires("dm-control")]
    needed = {canonicalize_name(r.name) for r in theirs if not r.marker}
    assert needed - newest == {"labmaze", "setuptools"}, "neither is imported by dm_control.suite"
    assert "dm-control" not in newest


def test_readme_make_targets_exist():
    readme, makefile = (ROOT / "README.md").read_text(), (ROOT / "Makefile").read_text()
    for command in ("demo", "test"):
        assert f"make {command}" in readme
        assert re.search(rf"^{command}:", makefile, re.MULTILINE)
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_readme_names_all_methods_and_algorithms():
    readme = (ROOT / "README.md").read_text()
    assert [name for name in [*METHODS, *ALGORITHMS] if f"`{name}`" not in readme] == []


OF_OTHERS = {"--rm", "--strict", "--address", "--has", "--start-from"}
"""Documented flags of docker, mkdocs, ray and tools/."""


def test_documented_flags_exist(capsys):
    """Flags in the text of README and docs; test_docs parses those in code blocks."""
    for command in (*COMMANDS, "sweep run --executor slurm", "sweep run --executor ray"):
        with pytest.raises(SystemExit):
            main([*command.split(), "--help"])
    configs = (PretrainConfig, FinetuneConfig, NavigationConfig)  # their help omits options of plug-ins not selected
    options = {field.name for config in configs for field in fields(config)} | option_names()
    known = set(FLAG.findall(capsys.readouterr().out)) | {f"--{name}".replace("_", "-") for name in options}
    named = set()
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        codes = re.findall(r"`[^`]+`", text)
        named |= {(page.name, flag) for code in codes for flag in FLAG.findall(code)}
    assert len(named) > 150
    wrong = {(page, flag) for page, flag in named if flag.replace("--no-", "--") not in known | OF_OTHERS}
    assert wrong == set()


def test_no_machine_paths_in_tracked_files():
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    pattern = r"(/home/[a-z]+|/root/|/tmp/[a-z]|\"(data|encoder|out)\": \"/[a-z])"  # the last: in rows
    found = subprocess.run(
        ["git", "grep", "-nIE", pattern, "--", ".", ":!tests/test_project.py"], cwd=ROOT, capture_output=True, text=True
    )
    assert found.stdout == ""


def test_changelog_starts_with_current_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE).group(1) == version


def test_wheel_contains_all_package_files_and_two_agents(tmp_path):
    for name in (*PACKAGES, "pyproject.toml", "setup.py", "README.md", "LICENSE"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    with ZipFile(build_wheel(tmp_path)) as wheel:
        packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    there = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in _files(ROOT / package)}
    assert packed == {
        name for name in there if not re.match(r"vd4rl_pomdp/agents/(cheetah_run|.*(/random|_seed\d))/", name)
    }
    assert sum(name.endswith("/card.json") for name in packed) == 2


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
