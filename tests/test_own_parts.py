"""The documentation's examples of parts of one's own, each executed as it stands; test_own_task has tasks."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers_data import write_fake_set
from tests.helpers_pages import isolated_registries, load_example, write_example
from vd4rl_pomdp import testing
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.report import write_report

BY_CALL = "registered by a call"
EXAMPLES = {
    "method": ("past_to_frame", "future_dim", 16),
    "corruption": ("bars", "bar_height", 24),
    "algorithm": ("filtered_bc", "cloned_share", 0.25),
    "frame_encoder": ("tiny", "tiny_channels", 12),
}
"""Kind: name of the part on its page, an option of its own and a value that is not the default."""
PLAYED = ("corruption", "frame_encoder")
"""Kinds that worker processes meet when they evaluate: they run the script's module level."""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Imports a page's file as a module; what it registers is forgotten at the end."""
    with isolated_registries():
        yield lambda kind: load_example(f"my_{kind}.py", tmp_path, monkeypatch)


def run(script: Path, line: str, folder: Path) -> None:
    """Run a command line of a script."""
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(folder / "cache")}
    command = [sys.executable, str(script), *line.split()]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kind", EXAMPLES)
def test_an_example_runs_through_every_stage_and_the_record_names_it(tmp_path, kind):
    name, option, value = EXAMPLES[kind]
    script, runs = write_example(f"my_{kind}.py", tmp_path), tmp_path / "runs"
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    flags = f"--{kind} {name} --{option} {value} ".replace("_", "-").replace(name.replace("_", "-"), name)
    first, second = ("", flags) if kind == "algorithm" else (flags, "")
    common = f"--preset smoke --data {data}"
    run(script, f"pretrain {first} {common} --out {runs}/pretrain", tmp_path)
    finetune = f"finetune {second} --encoder {runs}/pretrain/encoder {common} --out {runs}/finetune"
    workers = 2 if kind in PLAYED else 1
    run(script, f"{finetune} --workers {workers} --eval-episodes 2", tmp_path)
    write_report([runs], tmp_path / "report")
    stage = "finetune" if kind == "algorithm" else "pretrain"
    record = json.loads((runs / stage / "config.json").read_text())
    assert record["plugins"] == {f"{kind} {name}": BY_CALL}
    assert (record["config"][kind], record["config"][option]) == (name, value)
    (row,) = csv.DictReader((tmp_path / "report" / "summary.csv").open())
    assert row.get(kind, name) == name
    rows = list(csv.DictReader((runs / "finetune" / "episodes.csv").open()))
    as_trained = [row for row in rows if row["evaluated_under"] == row["corruption"]]
    assert len(as_trained) == 2 * 2, "two evaluations of two"
    assert len(rows) - len(as_trained) == (0 if as_trained[0]["corruption"] == "none" else 2), (
        "the last one is clean, too"
    )


@pytest.mark.parametrize("kind", EXAMPLES)
def test_help_shows_an_examples_flag_where_its_part_is_chosen_and_list_shows_the_part(load, capsys, monkeypatch, kind):
    name, option, _ = EXAMPLES[kind]
    load(kind)
    monkeypatch.setenv("COLUMNS", "200")
    stage, flag = "finetune" if kind == "algorithm" else "pretrain", f"--{option.replace('_', '-')}"
    for words, expected in (([f"--{kind.replace('_', '-')}", name], True), ([], False)):
        with pytest.raises(SystemExit) as end:
            main([stage, *words, "--help"])
        assert not end.value.code
        assert (flag in capsys.readouterr().out) == expected
    main(["list"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == [name])
    assert line.endswith(f"[{BY_CALL}]")


@pytest.mark.parametrize("kind", EXAMPLES)
def test_an_example_keeps_the_promises_of_its_kind(load, kind):
    name, option, value = EXAMPLES[kind]
    load(kind)
    check = getattr(testing, f"check_{kind}")
    check(name)
    check(name, **{option: value})


def test_a_wrong_claim_of_the_example_is_caught(load):
    load("method").PastToFrame.visible = lambda self, t, k, rows: ({t, t + k}, set())
    with pytest.raises(AssertionError, match=r"method 'past_to_frame' breaks a promise(.|\n)*is declared to see rows"):
        testing.check_method("past_to_frame")
