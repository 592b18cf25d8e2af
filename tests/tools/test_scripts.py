import importlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from vd4rl_pomdp.core.errors import UserError

SCRIPTS = Path(__file__).parents[2] / "tools"


def test_setup_recreates_environment_for_another_python(tmp_path):
    """Uses fake interpreters that print their version, log created environments, and accept other commands."""
    (tmp_path / "tools").mkdir()
    shutil.copy(SCRIPTS / "setup.sh", tmp_path / "tools")
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    for number in (11, 12):
        python = tmp_path / f"python3.{number}"
        make = f"mkdir -p .venv/bin; cp {python} .venv/bin/python; echo {number} >>{tmp_path}/made"
        python.write_text(f'#!/bin/sh\ncase "$*" in -V) echo Python 3.{number}.0;; "-m venv"*) {make};; esac\n')
        python.chmod(0o755)

    def made_after(**chosen):
        environment = {name: value for name, value in os.environ.items() if name != "PYTHON"}
        subprocess.run(["bash", "tools/setup.sh"], cwd=tmp_path, env=environment | chosen, check=True)
        return (tmp_path / "made").read_text().split()

    one, other = ({"PYTHON": str(tmp_path / f"python3.{number}")} for number in (11, 12))
    assert made_after(**one) == made_after(**one) == ["11"]
    assert made_after(**other) == made_after() == ["11", "12"]


def test_setup_needs_neither_debian_nor_gnu(tmp_path):
    """On a path with a few POSIX tools and a fake interpreter, which renders nothing while `broken` exists."""
    (tmp_path / "tools").mkdir()
    (tmp_path / "bin").mkdir()
    shutil.copy(SCRIPTS / "setup.sh", tmp_path / "tools")
    for name in ("pyproject.toml", "constraints.txt", "broken"):
        (tmp_path / name).touch()

    def program(name, text):
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)

    def setup():
        environment = {"PATH": str(tmp_path / "bin")}
        done = subprocess.run([bash, "tools/setup.sh"], cwd=tmp_path, env=environment, capture_output=True, text=True)
        return done.returncode, done.stderr.splitlines()[-1:]

    bash = shutil.which("bash")
    for name in ("cat", "cksum", "cp", "dirname", "mkdir", "tail"):
        program(name, f'exec {shutil.which(name)} "$@"')
    means = "install with your system's package manager, then re-run the same command"
    assert setup() == (2, [f"setup: needs python3 python3-venv: {means}"])
    fails = "*make_env*) [ ! -e broken ] || { echo x.UserError: cannot render >&2; exit 1; }"
    makes = '"-m venv"*) mkdir -p .venv/bin; cp bin/python3 .venv/bin/python'
    program("python3", f'case "$*" in -V) echo Python 3.11.0;; {makes};; {fails};; esac')
    assert setup() == (2, ["setup: rendering fails: cannot render"])
    (tmp_path / "broken").unlink()
    assert setup()[0] == 0
    assert setup() == (0, []), "the stamp is current"
    (tmp_path / "constraints.txt").write_text("numpy==2.0.0")
    assert setup() == (0, ["setup: installing Python packages (a few minutes the first time)"])


def test_generated_tables_are_current(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("page_tables")
    pages = {page: {name: list(lines) for name, lines in tables.items()} for page, tables in script.pages().items()}
    assert all(tables and all(len(lines) > 3 for lines in tables.values()) for tables in pages.values())
    for page, tables in pages.items():
        text = (SCRIPTS.parent / page).read_text()
        assert script.with_tables(text, tables, page) == text, f"{page}: run `python tools/page_tables.py`"


def test_tables_are_replaced_under_their_marks(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("page_tables")
    page = "a\n\n<!-- table: one -->\n| old |\n| older |\n\n| not it |\n<!-- table: other -->\nend"
    written = script.with_tables(page, {"other": ["| 2 |"], "one": ["| 1 |"]}, "page.md")
    assert written == "a\n\n<!-- table: one -->\n| 1 |\n\n| not it |\n<!-- table: other -->\n| 2 |\nend"
    with pytest.raises(
        UserError, match=r"^page.md: expected one line `<!-- table: new -->` above that table, found 0$"
    ):
        script.with_tables(page, {"new": ["| 3 |"]}, "page.md")


def test_papers_figure_has_a_panel_per_set_and_shows_what_was_not_run(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    script, tables = importlib.import_module("paper_figures"), importlib.import_module("earlier_table")
    (drawn,) = script.figures(tables.runs_of([str(tables.RESULTS / "protocol.toml")], ["protocol"])).values()
    panels = {axes.get_title(): axes for axes in drawn.axes}
    assert len(panels) == len(script.TASKS_SHOWN) * len(script.QUALITIES)
    assert [text.get_text() for text in panels["humanoid_walk expert"].texts] == ["not run"] * len(script.METHODS)
    shown = [text.get_text() for text in panels["walker_walk medium_expert"].texts]
    assert shown[:2] == ["n = 5", "n = 5"], "mik+a and mik"
    bar = panels["walker_walk medium_expert"].patches[0]
    assert bar.get_width() == pytest.approx(34.6, abs=0.05), "as in the page's table"
