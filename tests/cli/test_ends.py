"""Ends that no command asks for: a signal that an import hides, a pipe of a command's own, a system that is none."""

import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

from vd4rl_pomdp.cli import ends, main
from vd4rl_pomdp.cli.ends import run_to_end


def during(monkeypatch, act) -> None:
    monkeypatch.setattr(ends, "run_stage", lambda words: act())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_an_import_hides_is_one_all_the_same(monkeypatch, number):
    def half_imported() -> None:
        try:
            signal.raise_signal(number)
        except BaseException:
            raise AttributeError("module 'numpy' has no attribute 'matrix'") from None

    during(monkeypatch, half_imported)
    end = run_to_end(["pretrain"])
    assert (end.code, end.cause) == (128 + number, "interrupted")
    assert end.line == "ended by a signal: re-run the same command to resume"


def test_a_defect_without_a_signal_is_raised(monkeypatch):
    def fail() -> None:
        raise AttributeError("a defect")

    during(monkeypatch, fail)
    with pytest.raises(AttributeError, match="a defect"):
        run_to_end(["pretrain"])


def test_a_file_that_calls_main_while_a_worker_imports_it_is_told_where_to_put_that(monkeypatch, capsys):
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit) as end:
        main(["list"])
    assert end.value.code == 2
    assert 'put that call below if __name__ == "__main__":' in capsys.readouterr().err


def test_a_pipe_of_a_commands_own_is_no_reader_that_has_gone(monkeypatch):
    def write_to_a_helper() -> None:
        reader, writer = os.pipe()
        os.close(reader)
        try:
            os.write(writer, b"words")
        finally:
            os.close(writer)

    during(monkeypatch, write_to_a_helper)
    monkeypatch.setattr(ends, "_nobody_reads", lambda: False)
    with pytest.raises(BrokenPipeError):
        run_to_end(["pretrain"])


def test_a_reader_that_has_gone_ends_a_command_without_a_word():
    program = "from vd4rl_pomdp.cli import main; main(['pretrain', '--help'])"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    assert (process.communicate()[1], process.returncode) == (b"", 141)


def test_a_system_that_is_not_supported_is_told_so_in_one_line():
    program = "import os, pathlib, vd4rl_pomdp; os.name = 'nt'; import vd4rl_pomdp.cli"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert told.stderr == "error: vd4rl-pomdp runs on Linux and macOS; on Windows use its subsystem for Linux (WSL)\n"
    assert told.returncode == 2
