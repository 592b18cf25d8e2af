"""The command line: help, one-line messages for invalid input, and exit codes."""

import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

from finetune.algorithms import ALGORITHMS
from finetune.algorithms.bc import BC
from vd4rl_pomdp.cli import COMMANDS, main, run_to_end, stages
from vd4rl_pomdp.cli.parsing import show
from vd4rl_pomdp.core.errors import TEMPORARY
from vd4rl_pomdp.core.registry import REGISTRIES

SWEEP = ["sweep", "run", "quick", "--out", "y", "--dry-run"]
PRETRAIN = ["pretrain", "--data", "x", "--out", "y"]
SLIPS = [
    (["pretrian"], "unknown command 'vd4rl-pomdp pretrian': choose one of demo, list, data"),
    (["data", "chekc"], "choose one of collect"),
    (["list", "--foo"], "Unrecognized options: --foo"),
    (["data", "check", "x\ny"], "x y: no such folder"),
    (["pretrain", "--preset", "huge"], "unknown preset 'huge': choose one of paper, cpu, smoke"),
    ([*PRETRAIN, "--method", "random", "--codes", "3"], "Unrecognized options: --codes"),
    ([*PRETRAIN, "--patch-size", "0", "--corruption", "patch"], "--patch-size is 0; it must be at least 1"),
    (["pretrain", "--data", "x"], "Missing from vd4rl-pomdp pretrain: --out"),
    (["pretrain", "--data", "x", "--out", os.fsdecode(b"\xff")], "'\\udcff' is not UTF-8"),
    (["pretrain", "--data", "x", "--out", ""], "--out is empty: is a shell variable unset?"),
    (["report", "x", "--out="], "--out is empty: is a shell variable unset?"),
    (["data", "check", ""], "a word is empty: is a shell variable unset?"),
    (["sweep", "run", "quick", "--out", "x", "--only"], "--only has no value: is a shell variable unset?"),
    (["report", "x", "--only", "--out", "y"], "--only has no value: is a shell variable unset?"),
    (["certify", "x", "patch", "--out", "y", "--change", "preset=cpu", "--change=seed=0"], "--change is given twice"),
    (["finetune", "--seeds", "0", "--seeds=1", "--out", "y"], "--seeds is given twice"),
    (["finetune", "--encoder", "a", "--data", "b", "--out", "c", "--veiws", "3"], "Perhaps you meant: --views"),
    (["evaluate", "nowhere", "--out", "new.csv"], "nowhere: holds no evaluated run"),
    (["navigation", "collect", "--out", "set"], "unknown --maze"),
    (["report"], "name at least one run folder"),
    (["results", "add", "--out", "x"], "name at least one run folder"),
    (["navigation", "report"], "name at least one run folder"),
    (["agents", "play"], "no agents given: name"),
    (["report", "nowhere"], "nowhere: no such folder"),
    (["theory", "--out", "file/below"], "file/below: cannot be used (not a directory)"),
    (["demo", "--preset", "huge"], "unknown preset 'huge': choose one of cpu, smoke"),
    (["sweep", "run", "huge", "--out", "x"], "unknown grid 'huge': choose one of certify, control,"),
    ([*SWEEP, "--change", "pretrain.method=acor"], "'acor': choose one of"),
    ([*SWEEP, "--executor", "cloud"], "unknown executor 'cloud': choose one of local"),
    (["sweep", "status", "file"], "file: holds no sweep"),
]


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_and_groups_have_help(name, capsys):
    with pytest.raises(SystemExit) as end:
        main([*name.split(), "--help"])
    assert end.value.code in (0, None)
    shown = capsys.readouterr().out
    assert name in shown
    assert "Args:" not in shown, "flags show only their own text"
    for words in ([], name.split()[: 0 if name.startswith("report") else -1]):
        main(words)
        assert COMMANDS[name][1] in capsys.readouterr().out


@pytest.mark.parametrize(("words", "message"), SLIPS)
def test_invalid_command_lines_print_one_line(words, message, capsys, tmp_path, monkeypatch):
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


def test_tilde_after_equals_sign_is_expanded(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(SystemExit):
        main(["pretrain", "--out=~/run", "--data=~/set"])
    assert f"error: {tmp_path}/set: no such folder" in capsys.readouterr().err


def raised(kind: type[BaseException], *words: object):
    def command(*_: object) -> None:
        raise kind(*words)

    return command


@pytest.mark.parametrize(
    ("act", "code", "line"),
    [
        (lambda *_: signal.raise_signal(signal.SIGINT), 130, "interrupted: re-run the same command to resume"),
        (lambda *_: signal.raise_signal(signal.SIGTERM), 143, "terminated: re-run the same command to resume"),
        (raised(FloatingPointError, "loss is nan"), 1, "error: training diverged, loss is nan; lower --learning-rate"),
        (raised(OSError, 28, "No space left", "a"), 75, "error: a: the disk is full: free some space and re-run"),
    ],
)
def test_exit_codes_and_messages(act, code, line, monkeypatch):
    monkeypatch.setattr(stages, "list_parts", act)
    end = run_to_end(["list"])
    assert end.code == code
    assert end.line.startswith(line)


def test_defects_are_raised(monkeypatch):
    monkeypatch.setattr(stages, "list_parts", raised(AttributeError, "a defect"))
    with pytest.raises(AttributeError, match="a defect"):
        run_to_end(["list"])


def test_unguarded_main_call_in_a_worker_is_rejected(monkeypatch, capsys):
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit) as end:
        main(["list"])
    assert end.value.code == 2
    assert 'call main() below `if __name__ == "__main__":`' in capsys.readouterr().err


def test_help_imports_no_torch_and_survives_a_closed_pipe():
    code = (
        "import runpy, sys; sys.argv = ['x', '--help']; runpy.run_module('vd4rl_pomdp', run_name='__main__');"
        "sys.exit(bool({'numpy', 'torch', 'triton'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    words = [sys.executable, "-m", "vd4rl_pomdp", "theory", "--help"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    assert (process.communicate()[1], process.returncode) == (b"", 141)


@pytest.mark.parametrize(("words", "to", "code"), [
    ("data check nowhere", "2>/dev/full", 2), ("data check nowhere", ">/dev/full 2>&1", 2),
    ("sweep list", ">/dev/full 2>&1", TEMPORARY), ("sweep list", ">&-", 0),
])  # fmt: skip
def test_full_disk_under_the_log_keeps_the_exit_code(words, to, code):
    command = f"{sys.executable} -m vd4rl_pomdp {words} {to}"
    assert subprocess.run(command, shell=True, check=False).returncode == code


CONFIGURED = {"list", "data collect", "data view", "pretrain", "finetune", "evaluate", "navigation collect"}
CONFIGURED |= {"navigation train", "navigation policy"}
"""Commands whose flags are those of configs and parts that need torch, and the list of these parts."""


def test_help_and_the_list_of_grids_need_no_torch():
    words = [["sweep", "list"], *([*name.split(), "--help"] for name in COMMANDS if name not in CONFIGURED)]
    code = (
        "import contextlib, sys; from vd4rl_pomdp.cli import main\n"
        f"for words in {words}:\n"
        "    with contextlib.suppress(SystemExit): main(words)\n"
        "    if 'torch' in sys.modules: sys.exit(f'{words} loads torch')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(words) - 1
    assert "paper_patch_zero" in done.stdout


def test_missing_extra_is_named(tmp_path):
    words = ["navigation", "collect", "--maze", "no_curtain", "--preset", "smoke", "--workers", "1", "--out", "x"]
    code = (
        "import sys; sys.modules['gymnasium_robotics'] = None; from vd4rl_pomdp.cli import main\n"
        f"if __name__ == '__main__': main({words})"
    )
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "`pip install '.[navigation]'`" in done.stderr


def test_messages_are_escaped_on_ascii_terminals():
    line, environment = [sys.executable, "-m", "vd4rl_pomdp"], os.environ | {"PYTHONIOENCODING": "ascii"}
    refused = subprocess.run([*line, "data", "check", "ζ"], capture_output=True, env=environment)
    assert (refused.returncode, refused.stderr.count(b"\n")) == (2, 1)
    assert refused.stderr.startswith(b"error: \\u03b6: no such folder")


WINDOWS = """
import os, signal, sys, vd4rl_pomdp
os.name, sys.modules["fcntl"] = "nt", None
del signal.SIGHUP
import vd4rl_pomdp.cli
"""


def test_windows_is_refused_in_one_line():
    refused = subprocess.run([sys.executable, "-c", WINDOWS], capture_output=True, text=True)
    assert (refused.returncode, refused.stderr) == (2, "error: Windows is not supported: use WSL\n")


def test_printed_results_take_one_line_each(capsys):
    show({"shards": [f"{i}.hdf5" for i in range(100)], "render": {"mujoco": ["3.11.0"]}, "seconds": 0.123456789}, False)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["shards", "0.hdf5", "...", "99.hdf5", "(100)"],
        ["render.mujoco", "3.11.0"],
        ["seconds", "0.123457"],
    ]


def test_list_describes_every_plugin_and_its_origin(capsys, monkeypatch):
    class Mine(BC):
        """My own algorithm.

        More about it.
        """

        summary = ""

    monkeypatch.setattr(ALGORITHMS, "broken", {"theirs": "their_package: ImportError: gone"})
    with ALGORITHMS.isolated():
        ALGORITHMS.register("mine", Mine)
        main(["list"])
    shown = capsys.readouterr().out
    lines = {line.split()[0]: line.split(maxsplit=1)[1:] for line in shown.splitlines() if line.startswith("  ")}
    assert set(REGISTRIES) == {"method", "corruption", "algorithm", "format", "frame_encoder", "history", "task"}
    for registry in REGISTRIES.values():
        assert f"--{registry.setting.replace('_', '-')}   " in shown
        assert registry.group in shown
        assert [name for name in registry if not lines.get(name)] == []
    assert "  mine      My own algorithm   [registered by a call]" in shown
    assert "  theirs    cannot be loaded: their_package: ImportError: gone" in shown
