"""Parts of one's own, by call and by entry point; what an installed package breaks, breaks nothing else."""

import os
import re
import subprocess
import sys
from hashlib import sha256
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import vd4rl_pomdp.core.registry
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import REGISTRIES, Registry, origins

THEIRS, PAGE = "theirs", 3
SHOW = """registry = Registry("kind", {}, lambda part: True, "anything")
registry.register("mine", PART)
print(registry.source("mine"))
"""
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}


@pytest.fixture
def registry(monkeypatch):
    monkeypatch.setattr(vd4rl_pomdp.core.registry, "REGISTRIES", {})
    return Registry("frame encoder", {"own": "ours", "own+a": "ours, too"}, lambda p: isinstance(p, str), "a string")


def offer(monkeypatch, **values: str) -> None:
    entries = [EntryPoint(name, value, "vd4rl_pomdp.frame_encoders") for name, value in values.items()]
    monkeypatch.setattr(
        vd4rl_pomdp.core.registry, "entry_points", lambda group: [e for e in entries if e.group == group]
    )


def test_all_kinds_have_a_registry():
    import pretrain.objectives

    assert REGISTRIES["method"] is pretrain.objectives.METHODS


def test_a_call_adds_a_part(registry):
    registry.register("mine", "my own")
    assert registry.named("mine") == registry["mine"] == "my own"
    assert list(registry) == ["own", "own+a", "mine"]


def test_what_a_block_registers_is_forgotten_after_it(registry):
    with registry.isolated():
        registry.register("mine", "my own")
        assert "mine" in registry
    assert "mine" not in registry
    assert registry.origin("mine") == ""


def test_what_packages_offer_outlives_a_block_that_met_it_first(registry, monkeypatch):
    offer(monkeypatch, theirs="tests.core.test_registry:THEIRS")
    with registry.isolated():
        assert "theirs" in registry
    assert "theirs" in registry


def test_an_unknown_name_is_told_the_choices(registry):
    with pytest.raises(
        UserError, match="unknown frame encoder 'owl': choose one of own, own\\+a, or run the file that registers it"
    ):
        registry.named("owl")
    with pytest.raises(UserError, match="unknown frame encoder 'owl'"):
        registry.check("owl")
    registry.check("own")


def test_a_taken_name_is_refused(registry):
    with pytest.raises(UserError, match="a frame encoder called 'own' exists already"):
        registry.register("own", "mine")


def test_what_a_call_added_may_be_replaced_where_that_is_said(registry):
    registry.register("mine", "first")
    with pytest.raises(UserError, match="'mine' exists already: choose another name, or replace=True"):
        registry.register("mine", "second")
    registry.register("mine", "second", replace=True)
    assert registry["mine"] == "second"
    with pytest.raises(UserError, match=r"'own' exists already: choose another name$"):
        registry.register("own", "second", replace=True)
    with pytest.raises(UserError, match="is called 3: a name is a string"):
        registry.register(3, "third")


@pytest.mark.parametrize("name", ["", "..", "a,b", "lab/mine", "my own", "a=b"])
def test_a_name_that_no_folder_or_flag_could_have_is_refused(registry, name):
    with pytest.raises(UserError, match=f"frame encoder '{name}': folders and `--only` are made of names"):
        registry.register(name, "my own")


def test_a_part_of_another_kind_is_refused(registry):
    with pytest.raises(UserError, match="frame encoder 'three' is a int, not a string"):
        registry.register("three", 3)


def no_yours(name, part):
    if part == "yours":
        raise UserError("it is yours: choose mine")


def test_a_part_that_cannot_work_is_refused_however_it_comes(registry, monkeypatch, capsys):
    registry._refuse = no_yours
    told = "frame encoder 'a': it is yours: choose mine"
    with pytest.raises(UserError, match=told):
        registry.register("a", "yours")
    with pytest.raises(UserError, match=told):
        Registry("frame encoder", {"b": "mine", "a": "yours"}, lambda part: True, "anything", no_yours)
    monkeypatch.setattr("tests.core.test_registry.THEIRS", "yours")
    offer(monkeypatch, a="tests.core.test_registry:THEIRS")
    assert "a" not in registry
    assert told in capsys.readouterr().err


def test_an_entry_point_offers_a_part(registry, monkeypatch):
    offer(monkeypatch, theirs="tests.core.test_registry:THEIRS")
    assert registry.named("theirs") == "theirs"
    assert len(registry) == len(list(registry)) == 3, "loaded once"


def test_what_is_known_at_import_loads_no_package(registry, monkeypatch):
    offer(monkeypatch, theirs="tests.core.test_registry:THEIRS")
    assert list(registry.registered()) == ["own", "own+a"]
    assert "theirs" in registry
    assert list(registry.registered()) == ["own", "own+a", "theirs"]


def test_a_package_and_its_version_are_the_origin_of_what_it_offers(registry, monkeypatch):
    from importlib.metadata import entry_points

    script = next(e for e in entry_points(group="console_scripts") if e.dist.name == "pytest")
    offered = EntryPoint("theirs", "tests.core.test_registry:THEIRS", registry.group)._for(script.dist)
    monkeypatch.setattr(vd4rl_pomdp.core.registry, "entry_points", lambda group: [offered])
    assert registry.origin("theirs") == f"pytest {pytest.__version__}"
    assert registry.origin("own") == ""


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_package:METHOD", "no_such_package:METHOD: ModuleNotFoundError"),
        ("tests.core.test_registry:NOWHERE", "AttributeError"),
        ("tests.core.test_registry:PAGE", "is a int, not a string"),
    ],
)
def test_a_part_that_cannot_be_loaded_is_named_once_and_left_out(registry, monkeypatch, capsys, value, reason):
    offer(monkeypatch, broken=value, theirs="tests.core.test_registry:THEIRS")
    assert registry.named("own") == "ours"
    assert registry.named("theirs") == "theirs"
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: frame encoder 'broken' cannot be loaded")
    assert reason in line
    assert "broken" not in registry
    with pytest.raises(UserError, match="'broken' cannot be loaded"):
        registry.named("broken")


def test_settings_name_their_parts_and_where_these_come_from(registry, monkeypatch):
    offer(monkeypatch, theirs="tests.core.test_registry:THEIRS")
    registry.register("mine", "my own")
    by_call, offered = "registered by a call", "an installed package"
    assert origins({"frame_encoder": "own", "steps": 3}) == {}
    assert origins({"frame_encoder": "mine"}) == {"frame_encoder mine": by_call}
    assert origins({"frame_encoder": "mine+theirs"}) == {
        "frame_encoder mine": by_call,
        "frame_encoder theirs": offered,
    }
    assert origins({"frame_encoder": "own+a"}) == {}


def test_a_package_that_offers_a_taken_name_disables_no_other_part(registry, monkeypatch, capsys):
    offer(monkeypatch, own="tests.core.test_registry:THEIRS")
    assert registry.named("own") == "ours"
    assert "a frame encoder called 'own' exists already" in capsys.readouterr().err


LAYOUTS = {
    "a sibling": ("mine.py", "from helper import PART", "helper.py"),
    "a folder that is no package": ("mine.py", "import parts.helper\nPART = parts.helper.PART", "parts/helper.py"),
    "a package, relative": ("study/mine.py", "from . import helper\nPART = helper.PART", "study/helper.py"),
    "a package, by its name": ("study/mine.py", "from study.helper import PART", "study/helper.py"),
    "the sibling of a sibling": ("mine.py", "from between import PART", "helper.py"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_source_of_a_part_is_its_file_and_what_that_imports_from_its_folder(tmp_path, layout):
    mine, statement, helper = LAYOUTS[layout]
    for folder in ("study", "wandb"):
        (tmp_path / folder).mkdir()
    (tmp_path / "parts").mkdir()
    (tmp_path / "study" / "__init__.py").touch()
    (tmp_path / "between.py").write_text("from helper import PART\n")
    file, other = tmp_path / mine, tmp_path / "other.py"
    file.write_text(
        f"import sys\nimport numpy, wandb\nfrom vd4rl_pomdp.core.registry import Registry\n{statement}\n{SHOW}"
    )
    words = ["-m", mine[:-3].replace("/", ".")] if "/" in mine else [mine]

    def source() -> str:
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    (tmp_path / helper).write_text("PART = 'first'\n")
    first = source()
    assert re.fullmatch(r"mine\.py [0-9a-f]{12}", first)
    other.write_text("changed = True\n")
    assert source() == first
    (tmp_path / helper).write_text("PART = 'second'\n")
    second = source()
    file.write_text(file.read_text() + "# changed\n")
    assert len({first, second, source()}) == 3


def test_a_file_that_imports_nothing_of_its_folder_is_named_by_its_own_hash(registry, tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("import numpy\nimport vd4rl_pomdp\nregistry.register('mine', 'my own')\n")
    exec(compile(file.read_text(), file, "exec"), {"registry": registry})
    assert registry.source("mine") == f"mine.py {sha256(file.read_bytes()).hexdigest()[:12]}"
