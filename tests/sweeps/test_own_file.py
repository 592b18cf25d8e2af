"""Parts from a file of one's own, whose name the processes of a sweep's jobs must be told."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
from vd4rl_pomdp.sweeps.work import DONE, FAILED, Ended, Work, ended, start_process

from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError

FILE = """
from sibling import SUMMARY
from vd4rl_pomdp.cli import main
from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC

class Mine(BC):
    summary = SUMMARY

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


def write_file(folder: Path, last: str) -> Path:
    """A file that registers an algorithm with the help of its neighbour, and ends in a statement."""
    folder.mkdir()
    (folder / "sibling.py").write_text("SUMMARY = 'told by its neighbour'\n")
    (folder / "own.py").write_text(FILE + last)
    return folder / "own.py"


def attempt(work: Work) -> Ended:
    return ended(work, start_process(work, {}).wait(120))


def test_a_job_is_refused_whose_file_changed_after_its_sweep_was_started(tmp_path):
    own = write_file(tmp_path / "folder", GUARD + "main()")
    then = "own.py 0123456789ab"
    work = Work("a", ("list",), tmp_path / "log", own_file={"init_main_from_path": str(own)})
    assert attempt(work).cause == DONE
    told = attempt(replace(work, sources={"algorithm mine": then}))
    words = "the file of algorithm mine has changed since the sweep was started: start the sweep again, or put it back"
    assert (told.cause, told.line) == (UserError.cause, f"error: {words}")


def test_jobs_know_the_parts_of_the_file_that_a_sweep_was_started_from(tmp_path):
    write_file(tmp_path / "folder", GUARD + "main()")
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25, 30])
    (tmp_path / "grid.toml").write_text(GRID)
    line = f"{sys.executable} folder/own.py sweep run grid.toml --out runs --data data"
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(tmp_path / "cache")}
    run = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "check": True}
    planned = subprocess.run([*line.split(), "--dry-run"], **run).stdout
    assert "\npython folder/own.py finetune " in planned
    assert subprocess.run(line.split(), **run).stdout == "all 3 jobs are finished\n"
    (record,) = (tmp_path / "runs").rglob("finetune-mine/config.json")
    told = json.loads(record.read_text())
    assert told["plugins"] == {"algorithm mine": "registered by a call"}
    assert told["command"].startswith("own.py finetune ")
    with (tmp_path / "folder" / "own.py").open("a") as file:
        file.write("# changed\n")
    again = subprocess.run([*line.split(), "--dry-run"], **run).stderr
    assert "warning: algorithm mine: 1 sets or runs count, though its code has changed since they began\n" in again
    (command,) = (words for words in planned.splitlines() if words.startswith("python folder/own.py finetune "))
    finished = subprocess.run([sys.executable, *shlex.split(command)[1:]], **run).stderr
    assert (
        "the code of algorithm mine has changed since this run began, which goes on or counts all the same" in finished
    )


def test_a_module_is_imported_by_its_name(tmp_path, monkeypatch):
    write_file(tmp_path / "folder", GUARD + "main()")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{tmp_path / 'folder'}:{os.environ.get('PYTHONPATH', '')}")
    work = Work("job", ("list",), tmp_path / "log", own_file={"init_main_from_name": "folder.own"})
    assert attempt(work).cause == "done"
    assert "told by its neighbour   [registered by a call]" in work.log.read_text()


def test_a_file_that_starts_its_sweep_when_it_is_imported_starts_none_in_a_job(tmp_path):
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25, 30])
    (tmp_path / "grid.toml").write_text(GRID)
    words = f"sweep run {tmp_path}/grid.toml --out {tmp_path}/runs --data {tmp_path}/data".split()
    file = write_file(tmp_path / "folder", f"main({words})")
    told = attempt(Work("job", ("list",), tmp_path / "log", own_file={"init_main_from_path": str(file)}))
    assert told.cause == FAILED
    assert told.line == 'error: a job cannot start a sweep: put the call that did below `if __name__ == "__main__":`'
    assert not list((tmp_path / "runs").rglob("config.json"))


def test_a_part_that_no_file_tells_of_is_refused_before_anything_runs(tmp_path, capsys, monkeypatch):
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25, 30])
    (tmp_path / "grid.toml").write_text(GRID)
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))  # a notebook's has no file
    with ALGORITHMS.isolated():
        ALGORITHMS.register("mine", BC)
        with pytest.raises(SystemExit) as end:
            main(["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "runs")])
    assert end.value.code == 2
    assert "error: algorithm mine: was registered in this process alone" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
