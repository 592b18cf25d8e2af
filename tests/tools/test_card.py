"""Packing runs for a machine without a network, running them there, and the returned results."""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.stages import check_cells

ROOT = Path(__file__).parents[2]
CARD = ROOT / "tools" / "card"
NOT_CARRIED = {"torch", "numpy", "wandb", "huggingface-hub"}
"""Packages that the machine provides or that trainings do not import."""
STUB = """
import json, os, signal, sys, time
from pathlib import Path
words = sys.argv[1:]
out = Path(words[words.index("--out") + 1])
if "--dry-run" in words:
    print(f"vd4rl-pomdp data collect --out '{out.parent / 'the set'}'\\n# 2 jobs, 0 done, 2 to do")
elif words[:2] == ["data", "collect"]:
    out.mkdir(parents=True)
elif words[:2] == ["results", "add"]:
    out.mkdir(exist_ok=True)
    (out / "runs.jsonl").write_text("its rows")
else:
    def end(*_):
        (out / "cut").mkdir()
        (out / "cut/config.json").write_text('{"stage": "finetune"}')
        sys.exit(143)
    signal.signal(signal.SIGTERM, end)
    run = out / "done"
    (run / "encoder").mkdir(parents=True)
    (run / "encoder/config.json").write_text("{}")
    (run / "encoder/model.safetensors").write_bytes(os.urandom(2**24))
    (run / "config.json").write_text('{"stage": "pretrain"}')
    (run / "timing.json").write_text("{}")
    print("trains", flush=True)
    time.sleep(60)
"""


def names(lines):
    return {canonicalize_name(Requirement(line).name) for line in lines}


def carried():
    return [line for line in (CARD / "packages.txt").read_text().splitlines() if line and line[0] != "#"]


def test_all_dependencies_are_packed_or_excluded():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {r for r in map(Requirement, project["dependencies"]) if "python_version >=" not in str(r.marker)}
    assert {canonicalize_name(r.name) for r in needed} - NOT_CARRIED <= names(carried())
    pinned = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    assert names(carried()) <= names(pinned)


WITHOUT = """
import sys
from importlib.metadata import packages_distributions, requires
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

there, new = set(), {"torch", "numpy", "scipy", *sys.argv[1].split()}
while new:
    there |= new
    needed = [Requirement(r) for name in new if name in {"torch", "scipy"} | there - set(sys.argv[1].split())
              for r in requires(name) or ()]
    new = {canonicalize_name(r.name) for r in needed if r.marker is None or r.marker.evaluate({"extra": ""})} - there
owners = packages_distributions()

class Missing:
    def find_spec(self, name, path=None, target=None):
        of = {canonicalize_name(one) for one in owners.get(name.partition(".")[0], ())}
        if of and not of & (there | {"vd4rl-pomdp"}):
            raise ModuleNotFoundError(f"{name} is not carried", name=name)

sys.meta_path.insert(0, Missing())
import vd4rl_pomdp.bench.gpu, vd4rl_pomdp.cli.report, vd4rl_pomdp.cli.stages, vd4rl_pomdp.sweeps.driver
"""


def test_commands_import_only_what_is_there():
    """On a machine with torch, numpy, scipy, what these require, and the carried packages."""
    subprocess.run([sys.executable, "-c", WITHOUT, " ".join(names(carried()))], check=True)


def test_packages_present_in_suitable_versions_are_not_packed(monkeypatch):
    monkeypatch.syspath_prepend(CARD)
    import pack

    left = set(names(carried())) - set(pack.wanted(["H5py==3.13.0", "mujoco==3.2.0", "rich", "joblib @ file:///here"]))
    assert left == {"h5py", "rich", "joblib"}


@pytest.mark.parametrize("grid", sorted(CARD.glob("*.toml")), ids=lambda path: path.stem)
def test_card_grids_are_valid(grid):
    for testing in (False, True):
        check_cells(load_grid(str(grid), testing=testing).cells(), grid.stem)


def test_card_run_stops_at_its_limit_and_continues(tmp_path):
    program = tmp_path / "card" / "site" / "vd4rl_pomdp"
    program.mkdir(parents=True)
    shutil.copy(CARD / "run.py", program.parents[1])
    (program / "data").mkdir()
    for module in ("__init__", "data/__init__"):
        (program / f"{module}.py").touch()
    (program / "data/parity.py").write_text("def render_info(): return 'a renderer'")
    (program / "__main__.py").write_text(STUB)
    (program.parent / "torch.py").write_text(
        "import types; __version__ = '2'; cuda = types.SimpleNamespace(device_count=lambda: 0, get_device_name=None)"
    )
    env = os.environ | {"PYTHONPATH": ""}
    words = [sys.executable, str(program.parents[1] / "run.py"), "--seconds", "300", "--work", str(tmp_path / "work")]

    def call(out, *more):
        subprocess.run([*words, "--out", str(tmp_path / out), *more], env=env, check=True, capture_output=True)
        return (tmp_path / out / "log.txt").read_text()

    log = call("first", "--bring", "20", "grid=2", "--", "--jobs", "2")
    assert "the set: collected" in log
    assert "drawn by a renderer" in log
    assert "trains\n" in log
    assert "asked to end" in log
    assert "exit code 143" in log
    first = tmp_path / "first"
    assert (first / "results/runs.jsonl").read_text() == "its rows"
    with tarfile.open(first / "records.tar.xz") as file:
        assert {"cut/config.json", "done/config.json", "done/timing.json"} <= set(file.getnames())
    assert sorted(path.stat().st_size for path in first.glob("encoders.tar.*"))[-1] == 15 * 2**20

    content = (tmp_path / "work/runs/done/encoder/model.safetensors").read_bytes()
    shutil.rmtree(tmp_path / "work")
    assert "no time left" in call("second", "--home", str(first), "--seconds", "10", "grid")
    assert (tmp_path / "work/runs/done/encoder/model.safetensors").read_bytes() == content
    assert not (tmp_path / "work/runs/cut").exists()
