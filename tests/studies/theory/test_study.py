import json
import re
from importlib.resources import files
from pathlib import Path

import pytest
from matplotlib.text import Annotation

from tests.helpers_report import write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report import write_report
from vd4rl_pomdp.report.theory import diagram_figure, table_rows
from vd4rl_pomdp.studies.theory import table
from vd4rl_pomdp.studies.theory.facts import FACTS
from vd4rl_pomdp.studies.theory.small import SIZES, small_worlds

OUT = "page"


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What the command prints as JSON, and the folder it writes."""
    import contextlib
    import io

    out, text = tmp_path_factory.mktemp("theory") / OUT, io.StringIO()
    with contextlib.redirect_stdout(text):
        main(["theory", "--json", "--out", str(out)])
    return json.loads(text.getvalue()), out


def row_of(study, world, method):
    return next(row for row in study["tables"][world] if row["method"] == method)


def test_the_computed_table(shown):
    study, _ = shown
    correct = {w: [row["method"] for row in rows if row["correct"]] for w, rows in study["tables"].items()}
    assert correct == {
        "counterexample": ["mik+a literal"],
        "echo": ["mik", "mik+a", "mik+a literal"],
        "momentum": ["fj", "mik+a"],
    }
    complete = {w: [row["method"] for row in rows if row["complete"]] for w, rows in study["tables"].items()}
    assert complete["counterexample"] == []
    assert complete["echo"] == ["fj", "fj+a", "fj+a literal"]
    assert "mik+a" in complete["momentum"]
    assert not {"ah", "ah+a"} & set(complete["momentum"])
    assert row_of(study, "momentum", "mik+a")["discards"]
    assert not row_of(study, "counterexample", "fj")["discards"]


def test_the_papers_equations_where_their_assumptions_hold(shown):
    study, _ = shown
    broken = {(row["method"], row["where"]) for row in study["equations"] if row["decodes"] and row["fails_k"]}
    assert broken == {
        ("fj", "k > m"),
        ("fj+a", "k > m"),
        ("fj+a literal", "k > m"),
        ("mik+a literal", "every k"),
    }
    early = [r for r in study["equations"] if r["method"] == "fj+a" and r["where"] == "k <= m"]
    assert all(row["holds_k"] and not row["fails_k"] for row in early)


def test_every_printed_claim_that_fails_where_its_assumptions_hold_is_an_instance_of_a_fact(shown):
    """Twenty rows, of which the facts make four kinds; what the paper does not claim is not among them."""
    study, _ = shown
    counts = {fact["name"]: len(fact["in_table"]) for fact in study["facts"] if fact["in_table"]}
    assert sum(counts.values()) == 20
    assert counts == {"reaches_back": 14, "leaked_mask": 2, "merged_states": 2, "merged_phases": 1, "needed_noise": 1}
    failed = [
        (world, row["method"], column)
        for world, rows in study["tables"].items()
        for row in rows
        for column in table.COLUMNS
        if table.printed(row["method"])[column] and not row[column] and row["decodes_past"] and row["decodes_end"]
    ]
    shown_by = [row for fact in study["facts"] for row in fact["in_table"]]
    told = [(row["world"], row["method"], row["claim"]) for row in shown_by if row["claim"] != "equation"]
    assert sorted(told) == sorted(failed)
    assert ("momentum", "mik+a", "correct") not in told


def test_a_fact_says_what_is_printed_what_is_exact_and_what_is_left(shown):
    study, _ = shown
    assert [fact["name"] for fact in study["facts"]] == [fact.name for fact in FACTS]
    for fact in study["facts"]:
        assert all(world["rest_holds"] for world in fact["worlds"])
        assert not re.search(r"\{(?!t)", json.dumps([fact["printed"], fact["holds"]])), "an unfilled place"
        for world in fact["worlds"]:
            assert not re.search(r"\{(?!t)", world["exact"])
            numbers = [value for value in world["numbers"].values() if isinstance(value, int)]
            assert any(re.search(rf"\b{number}\b", world["exact"]) for number in numbers)
    first = study["facts"][0]["worlds"][0]
    assert (first["world"], first["smallest"], first["states"], first["observations"]) == ("ladder", True, 3, 2)
    assert first["exact"] == (
        "with m = 1, k = 2, s_t = 1, s_{t+k} = 0, P(a_t = 0) is 1 given what is seen and 1/3 given the states"
    )


def test_noise_changes_no_entropy(shown):
    study, _ = shown
    keys = ("world", "state_dependent", "method", "k")
    plain = {tuple(r[k] for k in keys): r["entropy"] for r in study["comparisons"] if not r["noise"]}
    noisy = [r for r in study["comparisons"] if r["noise"]]
    assert len(noisy) > 100
    for row in noisy:
        assert row["entropy"] == pytest.approx(plain[tuple(row[k] for k in keys)], abs=1e-12)


def test_the_page_stands_alone(shown):
    study, out = shown
    assert json.loads((out / "theory.json").read_text()) == study
    text = (out / "index.html").read_text()
    assert "16368" in text
    assert text.count("<svg") == 3
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_the_page_about_runs_has_the_same_section(shown, tmp_path):
    study, folder = shown
    write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    text = write_report([tmp_path / "runs", folder], tmp_path / "out")[0].read_text()
    template = files("vd4rl_pomdp.report").joinpath("theory_section.html").read_text()
    for title in re.findall(r"<h[23]>.*?</h[23]>", template):
        assert title in text
    assert study["facts"][0]["title"] in text
    alone, *_ = write_report([tmp_path / "runs"], tmp_path / "alone")
    assert "finite worlds" not in alone.read_text()


def test_studies_that_cannot_be_reported_are_one_line(shown, tmp_path):
    study, folder = shown
    run = write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "theory.json").write_text((folder / "theory.json").read_text())
    with pytest.raises(UserError, match="two studies of the theory"):
        write_report([tmp_path], tmp_path / "out")
    for damage in ({"printed": {}}, {"counterexample": ["of another type"]}):
        (tmp_path / "one" / "theory.json").write_text(json.dumps(study | damage))
        with pytest.raises(
            UserError, match=r"is no whole study \(.*\); write it again: vd4rl-pomdp theory --out .*one"
        ):
            write_report([run, tmp_path / "one"], tmp_path / "out")
    (tmp_path / "one" / "theory.json").write_text("{")
    with pytest.raises(UserError, match="cannot be read as JSON"):
        write_report([run, tmp_path / "one"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_figure_draws_every_transition_with_its_action(shown):
    study, _ = shown
    figure = diagram_figure(study)
    for axes in figure.axes:
        labels = [text.get_text() for text in axes.texts]
        assert (labels.count("+1"), labels.count("-1")) == (8, 8)
        assert sum(text.arrow_patch is not None for text in axes.texts if isinstance(text, Annotation)) == 16


def test_the_terminal_tables_say_the_same(shown, monkeypatch, capsys):
    study, _ = shown
    monkeypatch.setattr("vd4rl_pomdp.studies.theory.theory_study", lambda: study)
    main(["theory"])
    text = capsys.readouterr().out
    assert "16368 inverse examples" in text
    assert f"Where the paper and enumeration differ: {len(FACTS)} facts" in text
    for method in table.METHODS:
        assert method in text
    flat = " ".join(text.split())
    for number, fact in enumerate(study["facts"], 1):
        assert f"{number}. {fact['title']}" in flat
        for words in (fact["printed"], fact["holds"], fact["worlds"][0]["exact"]):
            assert words in flat
    assert "ladder*, 3 states: Action 1 climbs" in flat


@pytest.mark.parametrize("out", ["x", "x/below"])
def test_out_that_cannot_be_a_folder_is_one_line(out, tmp_path, capsys):
    (tmp_path / "x").write_text("")
    with pytest.raises(SystemExit) as end:
        main(["theory", "--out", str(tmp_path / out)])
    assert end.value.code == 2
    assert "cannot be used" in capsys.readouterr().err


def test_the_documentation_shows_the_computed_numbers(shown):
    study, _ = shown
    text = (Path(__file__).parents[3] / "docs" / "theory.md").read_text()
    for row in table_rows(study):
        entries = [f"{printed} / {' '.join(computed)}" for printed, *computed in row["entries"].values()]
        assert f"| `{row['method']}` | {' | '.join(entries)} |" in text
    assert [fact["title"] for fact in study["facts"]] == re.findall(r"^\d+\. \*\*(.*?)\.\*\*", text, re.MULTILINE)
    for fact in study["facts"]:
        for world in fact["worlds"]:
            name = world["world"] + (r"\*" if world["smallest"] else "")
            assert f"*{name}*" in text or name == "counterexample"
    assert f"{sum(1 for size in SIZES for _ in small_worlds(size)):,} worlds: all of up to three pairs" in text
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    names: dict = {}
    exec(code.replace("print(", "found = ("), names)
    assert names["found"].decodes_past is False
