"""Parts from a file of one's own, which the jobs of a sweep that it starts are started from, too."""

import json
import os
import subprocess
import sys
from types import ModuleType

import pytest

from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main

FILE = """
from vd4rl_pomdp.cli import main
from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC

class Mine(BC):
    summary = "one's own"

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
    """Runs the file with some words in a folder with a grid and its set."""
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25, 30])
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "folder").mkdir()
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(tmp_path / "cache")}

    def command(last: str, *how: str, words="sweep run grid.toml --out runs --data data"):
        (tmp_path / "folder" / "own.py").write_text(FILE + last)
        line = [sys.executable, *(how or ["folder/own.py"]), *words.split()]
        return subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    return command


def test_jobs_know_the_parts_of_the_file_that_a_sweep_was_started_from(tmp_path, run):
    shown = run(GUARD + "main()", "-m", "folder.own", words="sweep run grid.toml --out x --data data --dry-run").stdout
    assert "\npython -m folder.own finetune " in shown
    assert run(GUARD + "main()").stdout == "all 3 jobs are finished\n"
    (record,) = (tmp_path / "runs").rglob("finetune-mine/config.json")
    told = json.loads(record.read_text())
    assert told["plugins"] == {"algorithm mine": "registered by a call"}
    assert told["command"].startswith("own.py finetune ")
    again = run("# changed\n" + GUARD + "main()")
    assert (
        "warning: algorithm mine: 1 sets or runs count, though its code has changed since they began\n" in again.stderr
    )


def test_a_file_that_starts_its_sweep_whatever_its_words_starts_none_in_a_job(run):
    done = run(GUARD + "main('sweep run grid.toml --out runs --data data --only algorithm=mine'.split())")
    assert done.returncode == 1
    assert "a job cannot start a sweep: end the file in `main()`, which reads the job's own command line" in done.stderr


def test_a_part_that_no_file_tells_of_is_refused_before_anything_runs(tmp_path, run, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))  # a notebook's has no file
    with ALGORITHMS.isolated():
        ALGORITHMS.register("mine", BC)
        with pytest.raises(SystemExit) as end:
            main(["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "runs")])
    assert end.value.code == 2
    assert "error: algorithm mine: is registered only in this process" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
