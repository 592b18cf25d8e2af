import os
import subprocess
import sys

import pytest

from vd4rl_pomdp.cli import COMMANDS, ends, main
from vd4rl_pomdp.cli.parsing import show
from vd4rl_pomdp.runs.interrupt import Terminated

NAMES = [
    [name, *([inner] if inner else [])]
    for name, entry in COMMANDS.items()
    for inner in (entry if isinstance(entry, dict) else [None, *entry.inner])
]


@pytest.mark.parametrize("words", NAMES, ids=" ".join)
def test_every_command_has_help(words, capsys):
    with pytest.raises(SystemExit) as end:
        main([*words, "--help"])
    assert end.value.code in (0, None)
    assert words[-1] in capsys.readouterr().out


SWEEP = ["sweep", "run", "quick", "--out", "y", "--dry-run"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["pretrian"], "unknown command 'vd4rl-pomdp pretrian': choose one of demo, list, data"),
        (["data", "chekc"], "choose one of collect"),
        (["data", "check", "nowhere"], "nowhere"),
        (["pretrain", "--data", "nowhere", "--out", "x"], "nowhere: no such folder"),
        (["pretrain", "--preset", "huge"], "unknown preset 'huge': choose one of paper, cpu, smoke"),
        (["pretrain", "--data", "x", "--out", "y", "--corruption", "fog"], "unknown corruption 'fog'"),
        (["pretrain", "--data", "x", "--out", "y", "--method", "m"], "unknown method 'm'"),
        (["data", "collect", "--task", "ant", "--quality", "random", "--out", "x"], "unknown task 'ant'"),
        (["finetune", "--encoder", "nowhere", "--data", "nowhere", "--out", "x"], "nowhere"),
        (["report", "nowhere"], "nowhere: no such folder"),
        (["policy", "train", "--task", "ant", "--out", "x"], "unknown task 'ant'"),
        (["policy", "train", "--out", "x"], "--task"),
        (["policy", "train", "--task", "walker_walk", "--out", "x", "--seed", "-1"], "--seed is -1"),
        (["data", "check", "x\ny"], "x y: no such folder"),
        (["pretrain", "--data", "x", "--out", "y", "--precision", "fp8"], "Invalid choice invalid choice 'fp8'"),
        (["policy", "export", "nowhere", "--out", "x"], "nowhere"),
        (["policy", "train", "--task", "walker_walk", "--out", "file/below"], "file/below"),
        (["theory", "--out", "file/below"], "file/below: cannot be used (not a directory)"),
        (["data", "card", "nowhere"], "nowhere"),
        (["demo", "--preset", "huge"], "unknown preset 'huge': choose one of cpu, smoke"),
        (["pretrain", "--data", "x"], "Missing from vd4rl-pomdp pretrain: --out"),
        (["pretrain"], "Missing from vd4rl-pomdp pretrain: --data PATH"),
        (["finetune"], "--encoder"),
        (["navigation", "train"], "--data"),
        (["navigation", "collect"], "--maze"),
        (["pretrain", "--data", "", "--out", "y"], "--data names nothing"),
        (["pretrain", "--data=", "--out", "y"], "--data= names nothing"),
        (["pretrain", "--data", "x", "--out", os.fsdecode(b"\xff")], "'\\udcff' is not UTF-8"),
        (["evaluate", ""], "the first word names nothing"),
        (["report"], "no runs are named: name at least one"),
        (["sweep", "run", "huge", "--out", "x"], "unknown grid 'huge': choose one of control,"),
        (["sweep", "run", "nowhere.toml", "--out", "x"], "nowhere.toml: cannot be used (no such file or directory)"),
        (["sweep", "run", "quick"], "Missing from vd4rl-pomdp sweep run: --out"),
        ([*SWEEP, "--change", "preset=foo"], "unknown preset 'foo'"),
        ([*SWEEP, "--change", "seed=-1"], "--seed is -1"),
        ([*SWEEP, "--change", "steps=3"], "'steps' is no setting of a grid"),
        ([*SWEEP, "--change", "pretrain.method=acor"], "'acor': choose one of"),
        (
            [*SWEEP, "--change", "pretrain.method=random", "pretrain.codes=3"],
            "--codes is not read by the method random",
        ),
        (
            [*SWEEP, "--change", "pretrain.method=acro", "finetune.random_histories=0.5"],
            "--random-histories is not read: acro has no memory",
        ),
        ([*SWEEP, "--change", "pretrain.method=drq_bc", "finetune.views=2"], "--views is not read by"),
        ([*SWEEP, "--only", "method=curl"], "the grid has mik+a, acro, random; write name=value,value"),
        (
            [*SWEEP, "--only", "method=acro", "--only", "seed=0"],
            "--only is given twice: name all its values behind one",
        ),
        ([*SWEEP, "--change=seed=1", "--dry-run", "--change=preset=cpu"], "--change is given twice"),
        ([*SWEEP, "--preset", "cpu"], "--preset is a setting of the grid's trainings: change it by --change preset="),
        ([*SWEEP, "--executor", "cloud"], "unknown executor 'cloud': choose one of local"),
        (["sweep", "status", "file"], "file: holds no sweep; `vd4rl-pomdp sweep run GRID --out file` makes one"),
        (["sweep", "retry", "x"], "x: holds no sweep"),
        (["pretrain", "--data", "x", "--out", "y", "--steps", "many"], "--steps: invalid literal"),
        (["finetune", "--encoder", "a", "--data", "b", "--out", "c", "--veiws", "3"], "Perhaps you meant: --views"),
    ],
)
def test_a_slip_is_one_line_and_exit_code_2(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert error.startswith("error: ")
    assert message in error
    assert [p.name for p in tmp_path.iterdir()] == ["file"], "nothing may be left behind"


def test_a_tilde_behind_an_equals_sign_is_the_users_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(SystemExit):
        main(["pretrain", "--out=~/run", "--data=~/set"])
    assert f"error: {tmp_path}/set: no such folder" in capsys.readouterr().err


def test_a_signal_while_words_are_read_is_no_slip(monkeypatch):
    def end(*words, **options):
        raise Terminated

    monkeypatch.setattr("tyro.cli", end)
    ended = ends.run_to_end(["data", "check", "x"])
    assert (ended.code, ended.line) == (143, "terminated: re-run the same command to resume")


@pytest.mark.parametrize(("stage", "flag"), [("pretrain", "--precision"), ("finetune", "--update-precision")])
def test_a_training_that_diverged_names_its_own_flag(stage, flag, monkeypatch):
    def diverge(words):
        raise FloatingPointError("critic_loss is nan")

    monkeypatch.setattr(ends, "run_stage", diverge)
    end = ends.run_to_end([stage, "--out", "x"])
    assert (end.code, end.line) == (
        1,
        f"error: training diverged, critic_loss is nan; lower --learning-rate or use {flag} fp32",
    )


@pytest.mark.parametrize("package", ["vd4rl_pomdp", "vd4rl_pomdp.cli"])
def test_the_package_is_the_program_and_its_help_needs_neither_numpy_nor_torch(package, capsys):
    code = (
        f"import runpy, sys; sys.argv = ['x', '--help']; runpy.run_module({package!r}, run_name='__main__');"
        "sys.exit(bool({'numpy', 'torch', 'triton'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    main(["--help"])
    assert done.stdout == capsys.readouterr().out


def test_a_terminal_that_is_not_utf_8_is_shown_what_it_can():
    line = [sys.executable, "-m", "vd4rl_pomdp.cli"]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    shown = subprocess.run([*line, "theory", "--help"], capture_output=True, env=environment)
    assert (shown.returncode, shown.stderr) == (0, b"")
    refused = subprocess.run([*line, "data", "check", "ζ"], capture_output=True, env=environment)
    assert (refused.returncode, refused.stderr.count(b"\n")) == (2, 1)
    assert refused.stderr.startswith(b"error: \\u03b6: no such folder")


def test_without_words_the_commands_are_listed(capsys):
    main([])
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


def test_results_stay_on_one_line_each(capsys):
    show(
        {"shards": [f"{i}.hdf5" for i in range(100)], "dtypes": {"reward": ["float64"]}, "seconds": 0.123456789}, False
    )
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["shards", "0.hdf5", "...", "99.hdf5", "(100)"],
        ["dtypes.reward", "float64"],
        ["seconds", "0.123457"],
    ]


def test_a_tilde_before_no_user_is_a_word(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(["report", "nowhere", "--out=~no_such_user/x"])
    assert "nowhere: no such folder" in capsys.readouterr().err
