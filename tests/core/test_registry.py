"""Plug-ins registered by call and by entry point; a broken package affects nothing else."""

from hashlib import sha256
from importlib.metadata import EntryPoint, entry_points

import pytest

import vd4rl_pomdp.core.registry
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.registry import REGISTRIES, Registry, code_of, of_other_code

THEIRS, PAGE = "theirs", 3


def no_yours(name, part):
    if part == "yours":
        raise UserError("it is yours: choose mine")


@pytest.fixture
def registry(monkeypatch):
    monkeypatch.setattr(vd4rl_pomdp.core.registry, "REGISTRIES", {})
    own = {"own": "ours", "own+a": "ours, too"}
    return Registry("frame encoder", own, lambda part: isinstance(part, str), "a string", no_yours)


def offer(monkeypatch, **values: str) -> None:
    entries = [EntryPoint(name, value, "vd4rl_pomdp.frame_encoders") for name, value in values.items()]
    monkeypatch.setattr(vd4rl_pomdp.core.registry, "entry_points", lambda group: entries)


def test_methods_are_registered():
    import pretrain.objectives

    assert REGISTRIES["method"] is pretrain.objectives.METHODS


def test_register_within_isolated_block(registry):
    with registry.isolated():
        registry.register("mine", "my own")
        assert registry.named("mine") == registry["mine"] == "my own"
        assert list(registry) == ["own", "own+a", "mine"]
        registry.register("mine", "second", replace=True)
        assert registry["mine"] == "second"
    assert "mine" not in registry
    assert registry.origin("mine") == ""


@pytest.mark.parametrize(
    ("name", "part", "message"),
    [
        ("own", "mine", "a frame encoder called 'own' exists already"),
        ("three", 3, "frame encoder 'three' is a int, not a string"),
        ("a", "yours", "frame encoder 'a': it is yours: choose mine"),
        *(
            (name, "mine", f"frame encoder '{name}': names are part of paths")
            for name in ("", "..", "a,b", "x/y", "my own", "a=b")
        ),
    ],
)
def test_invalid_plugins_are_rejected(registry, monkeypatch, capsys, name, part, message):
    with pytest.raises(UserError, match=message):
        registry.register(name, part, replace=True)
    monkeypatch.setattr("tests.core.test_registry.THEIRS", part)
    offer(monkeypatch, **{name: "tests.core.test_registry:THEIRS"})
    assert list(registry) == ["own", "own+a"]
    assert message in capsys.readouterr().err


def test_unknown_name_lists_the_choices(registry):
    message = "unknown frame encoder 'owl': choose one of own, own\\+a, or run or import the file that registers it"
    with pytest.raises(UserError, match=message):
        registry.named("owl")


def test_entry_points_are_loaded_on_demand(registry, monkeypatch):
    script = next(e for e in entry_points(group="console_scripts") if e.dist.name == "pytest")
    offered = EntryPoint("theirs", "tests.core.test_registry:THEIRS", registry.group)._for(script.dist)
    monkeypatch.setattr(vd4rl_pomdp.core.registry, "entry_points", lambda group: [offered])
    assert list(registry.registered()) == ["own", "own+a"]
    with registry.isolated():
        assert registry.named("theirs") == "theirs"
    assert list(registry.registered()) == ["own", "own+a", "theirs"]
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
def test_broken_entry_point_warns_once(registry, monkeypatch, capsys, value, reason):
    offer(monkeypatch, broken=value, theirs="tests.core.test_registry:THEIRS")
    assert registry.named("own") == "ours"
    assert registry.named("theirs") == "theirs"
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: frame encoder 'broken' cannot be loaded")
    assert reason in line
    with pytest.raises(UserError, match="'broken' cannot be loaded"):
        registry.named("broken")


def test_record_names_plugins_and_detects_changed_code(registry, monkeypatch, tmp_path):
    offer(monkeypatch, theirs="tests.core.test_registry:THEIRS")
    file = tmp_path / "mine.py"
    file.write_text("registry.register('mine', 'my own')\n")
    exec(compile(file.read_text(), file, "exec"), {"registry": registry})
    mine, both = {"frame_encoder": "mine", "steps": 3}, {"frame_encoder": "mine+theirs"}
    assert code_of({"frame_encoder": "own+a"}) == {"plugins": {}, "sources": {}}
    record = code_of(mine)
    assert record == {
        "plugins": {"frame_encoder mine": "registered by a call"},
        "sources": {"frame_encoder mine": f"mine.py {sha256(file.read_bytes()).hexdigest()[:12]}"},
    }
    assert code_of(both)["plugins"] == record["plugins"] | {"frame_encoder theirs": "an installed package"}
    assert of_other_code(record, mine) == of_other_code({}, mine) == []
    for other in ({"sources": {"frame_encoder mine": "mine.py 0"}}, {"plugins": {"frame_encoder mine": "a 1.2"}}):
        assert of_other_code(record | other, mine) == ["frame_encoder mine"]
