"""`vd4rl-pomdp list` names every part of every kind, and what installed packages offer."""

import pytest

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.cli.parts import summary_of
from vd4rl_pomdp.core.registry import REGISTRIES


def test_every_part_has_a_line_that_says_what_it_is(capsys):
    main(["list"])
    shown = capsys.readouterr().out
    lines = {line.split()[0]: line.split(maxsplit=1)[1:] for line in shown.splitlines() if line.startswith("  ")}
    assert set(REGISTRIES) == {"method", "corruption", "algorithm", "frame_encoder", "task"}
    for registry in REGISTRIES.values():
        assert f"--{registry.setting.replace('_', '-')}   " in shown
        assert registry.group in shown
        assert [name for name in registry if not lines.get(name)] == []
    assert max(map(len, shown.splitlines())) <= 120


def test_what_is_not_the_packages_own_says_where_it_comes_from(capsys, monkeypatch):
    from finetune.algorithms import ALGORITHMS
    from finetune.algorithms.bc import BC

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
    assert "  mine      My own algorithm   [registered by a call]" in shown
    assert "  theirs    cannot be loaded: their_package: ImportError: gone" in shown


@pytest.mark.parametrize("words", [["--foo"], ["methods"]])
def test_it_takes_no_words(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(["list", *words])
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_part_that_says_nothing_of_itself_does_not_speak_for_its_base_class():
    class Told:
        """Something else."""

    assert summary_of(Told) == "Something else"
    assert summary_of(type("Silent", (Told,), {})) == ""


def test_a_summary_is_the_first_line_of_a_docstring_where_there_is_none():
    assert (
        summary_of(summary_of)
        == "What a part says of itself in a line: its `summary`, or the first line of its docstring"
    )
