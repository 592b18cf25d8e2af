import subprocess
from pathlib import Path
from zipfile import ZipFile

import pytest
import torch

from tests.helpers_wheel import build_wheel
from vd4rl_pomdp.runs import provenance
from vd4rl_pomdp.runs.provenance import COMMIT_FILE, checkout_commit, command, machine

ROOT = Path(__file__).resolve().parents[2]


def git(folder: Path, *words: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@b.c"]
    return subprocess.run(["git", *who, *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path) -> Path:
    root = tmp_path / "project"
    (root / "vd4rl_pomdp").mkdir(parents=True)
    (root / "pyproject.toml").write_text('[project]\nname = "vd4rl-pomdp"\n')
    git(root, "init", "-q")
    git(root, "add", "-A")
    git(root, "commit", "-qm", "first")
    return root


def test_checkout_commit_marks_local_changes(checkout):
    head = git(checkout, "rev-parse", "HEAD")
    assert checkout_commit(checkout) == head
    (checkout / "pyproject.toml").write_text('[project]\nname = "vd4rl-pomdp"\nversion = "2"\n')
    assert checkout_commit(checkout) == f"{head}+"


def test_enclosing_repository_of_another_project_is_ignored(checkout, monkeypatch):
    site = checkout / ".venv" / "lib" / "site-packages"
    (site / "vd4rl_pomdp" / "runs").mkdir(parents=True)
    assert checkout_commit(site) == ""
    (site / "pyproject.toml").write_text('[project]\nname = "vd4rl-pomdp"\n')
    assert checkout_commit(site) == ""
    (checkout / "pyproject.toml").write_text('[project]\nname = "thesis"\n')
    assert checkout_commit(checkout) == ""
    monkeypatch.setattr(provenance, "__file__", str(site / "vd4rl_pomdp" / "runs" / "provenance.py"))
    assert provenance.git_commit() == ""
    (site / COMMIT_FILE).write_text("abc\n")
    assert provenance.git_commit() == "abc"


def test_wheel_contains_its_commit(checkout):
    """The real setup.py on a package of one module, without fetching anything."""
    for name in ("setup.py", "vd4rl_pomdp/runs/provenance.py"):
        (checkout / name).parent.mkdir(exist_ok=True)
        (checkout / name).write_text((ROOT / name).read_text())
    (checkout / "vd4rl_pomdp" / "__init__.py").touch()
    (checkout / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "vd4rl-pomdp"\nversion = "0"\n[tool.setuptools]\npackages = ["vd4rl_pomdp"]\n'
    )
    git(checkout, "add", "-A")
    git(checkout, "commit", "-qm", "second")
    with ZipFile(build_wheel(checkout)) as wheel:
        assert wheel.read(COMMIT_FILE).decode().strip() == git(checkout, "rev-parse", "HEAD")


@pytest.mark.parametrize(
    ("script", "program"),
    [
        ("/usr/bin/vd4rl-pomdp", "vd4rl-pomdp"),
        ("/src/vd4rl_pomdp/__main__.py", "vd4rl-pomdp"),
        ("/src/vd4rl_pomdp/cli/__main__.py", "vd4rl-pomdp"),
        ("-c", "vd4rl-pomdp"),
        ("folder/my_method.py", "python my_method.py"),
    ],
)
def test_command_is_recorded_as_typed(monkeypatch, script, program):
    monkeypatch.setattr("sys.argv", [script, "--out", "a b"])
    assert command() == f"{program} --out 'a b'"


@pytest.mark.parametrize(("device", "named"), [("cpu", None), ("cuda:1", "card 1"), ("auto", "card None")])
def test_machine_names_the_gpu_in_use(monkeypatch, device, named):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda used: f"card {used.index}")
    assert machine(device)["gpu"] == named


def test_machine_names_processors_of_arm(tmp_path, monkeypatch):
    cores = [f"processor\t: {part}\nCPU implementer\t: 0x41\nCPU part\t: {part}\n" for part in ("0xd40", "0xd05")]
    (tmp_path / "cpuinfo").write_text("\n".join(cores))
    monkeypatch.setattr(provenance, "_CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert machine("cpu")["processor"] == "aarch64 0x41/0xd40"
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Some CPU\nmodel name\t: Other\n")
    assert machine("cpu")["processor"] == "Some CPU"
    monkeypatch.setattr("platform.system", lambda: "Darwin")
    monkeypatch.setattr(subprocess, "run", lambda words, **_: subprocess.CompletedProcess(words, 0, "Apple M2 Pro\n"))
    assert machine("cpu")["processor"] == "Apple M2 Pro"
