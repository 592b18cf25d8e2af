import pytest

from vd4rl_pomdp.runs.provenance import command


@pytest.mark.parametrize(
    ("script", "program"),
    [
        ("/usr/bin/vd4rl-pomdp", "vd4rl-pomdp"),
        ("/src/vd4rl_pomdp/__main__.py", "vd4rl-pomdp"),
        ("/src/vd4rl_pomdp/cli/__main__.py", "vd4rl-pomdp"),
        ("-c", "vd4rl-pomdp"),
        ("/src/pretrain/__main__.py", "vd4rl-pomdp pretrain"),
        ("/src/finetune/__main__.py", "vd4rl-pomdp finetune"),
        ("my_method.py", "my_method.py"),
    ],
)
def test_the_command_line_is_named_as_it_would_be_typed(monkeypatch, script, program):
    monkeypatch.setattr("sys.argv", [script, "--out", "a b"])
    assert command() == f"{program} --out 'a b'"
