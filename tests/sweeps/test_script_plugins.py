"""Plug-ins registered in a user's script that starts a sweep are available in its jobs."""

import json
import subprocess
import sys
from types import ModuleType

import pytest

from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC
from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set

FILE = """
from vd4rl_pomdp.cli import main
from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC

class Mine(BC):
    summary = "a user's algorithm"

ALGORITHMS.register("mine", Mine)
"""
GUARD = 'if __name__ == "__main__":\n    '
GRID = """
seed = 0
preset = "smoke"
[collect]
task = "walker_walk"
quality = "expert"
[pretrain]
method = "random"
[finetune]
algorithm = "mine"
eval_episodes = 1
"""


@pytest.fixture
def run(tmp_path):
    """Run the script in a folder with a grid and its dataset."""
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25, 30])
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "folder").mkdir()

    def command(last: str, *how: str, words="sweep run grid.toml --out runs --data data"):
        (tmp_path / "folder" / "own.py").write_text(FILE + last)
        line = [sys.executable, *(how or ["folder/own.py"]), *words.split()]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)

    return command


def test_sweep_jobs_load_plugins_of_the_starting_script(tmp_path, run):
    shown = run(GUARD + "main()", "-m", "folder.own", words="sweep run grid.toml --out x --data data --dry-run").stdout
    assert "\npython -m folder.own finetune " in shown
    assert run(GUARD + "main()").stdout == "all 3 jobs are finished\n"
    (record,) = (tmp_path / "runs").rglob("finetune-mine/config.json")
    config = json.loads(record.read_text())
    assert config["plugins"] == {"algorithm mine": "registered by a call"}
    assert config["command"].startswith("python own.py finetune ")
    again = run("# changed\n" + GUARD + "main()")
    assert (
        "warning: algorithm mine: 1 sets or runs count, though its code has changed since they began\n" in again.stderr
    )


def test_job_that_would_start_a_sweep_fails(run):
    done = run(GUARD + "main('sweep run grid.toml --out runs --data data --only algorithm=mine'.split())")
    assert done.returncode == 1
    assert "a job cannot start a sweep: end the file in `main()`, which reads the job's own command line" in done.stderr


def test_plugin_without_file_is_rejected(tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))  # as in a notebook, without a file
    with ALGORITHMS.isolated():
        ALGORITHMS.register("mine", BC)
        line = rejection(["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "runs")])
    assert line.startswith("error: algorithm mine: is registered only in this process")
    assert not (tmp_path / "runs").exists()
