import contextlib
import io
import json
import re
from pathlib import Path

import pytest

from tests.helpers_report import write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report.page import write_report
from vd4rl_pomdp.report.theory import table_rows


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The command's JSON output, and the folder it writes."""
    out, text = tmp_path_factory.mktemp("theory") / "page", io.StringIO()
    with contextlib.redirect_stdout(text):
        main(["theory", "--json", "--out", str(out)])
    return json.loads(text.getvalue()), out


def test_statements_that_fail_under_their_assumptions(shown):
    """All follow from five facts; entries that the paper does not claim are excluded."""
    study, _ = shown
    broken = {(row["method"], row["where"]) for row in study["equations"] if row["decodes"] and row["fails_k"]}
    assert broken == {("fj", "k > m"), ("fj+a", "k > m"), ("fj+a literal", "k > m"), ("mik+a literal", "every k")}
    (early,) = {
        str(row["fails_k"]) for row in study["equations"] if (row["method"], row["where"]) == ("fj+a", "k <= m")
    }
    assert early == "[]"
    rows = [(row["world"], row["method"], row["printed"]) for row in study["differences"]]
    assert [row for row in rows if row[2] in ("discards", "complete")] == [
        ("counterexample", "fj+a", "discards"),
        ("counterexample", "mik+a literal", "complete"),
        ("echo", "mik+a", "complete"),
        ("echo", "mik+a literal", "complete"),
    ]


def test_noise_does_not_change_entropies(shown):
    study, _ = shown
    keys = ("world", "state_dependent", "method", "k")
    plain = {tuple(r[k] for k in keys): r["entropy"] for r in study["comparisons"] if not r["noise"]}
    noisy = [r for r in study["comparisons"] if r["noise"]]
    assert len(noisy) > 100
    for row in noisy:
        assert row["entropy"] == pytest.approx(plain[tuple(row[k] for k in keys)], abs=1e-12)


def test_theory_page_is_self_contained(shown):
    study, out = shown
    assert json.loads((out / "theory.json").read_text()) == study
    text = (out / "index.html").read_text()
    assert "16368" in text
    assert text.count("<svg") == 2
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_report_includes_the_theory_section(shown, tmp_path):
    study, folder = shown
    run = write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    text = write_report([run, folder], tmp_path / "out")[0].read_text()
    assert study["facts"][0]["title"] in text
    without, *_ = write_report([run], tmp_path / "without")
    assert "finite worlds" not in without.read_text()


def test_invalid_studies_are_rejected(shown, tmp_path):
    study, folder = shown
    run = write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    (tmp_path / "theory.json").write_text(json.dumps(study | {"printed": {}}))
    with pytest.raises(UserError, match=r"is not a complete study \(.*\); write it again: vd4rl-pomdp theory --out "):
        write_report([run, tmp_path], tmp_path / "out")
    with pytest.raises(UserError, match="two studies of the theory"):
        write_report([run, tmp_path, folder], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_terminal_tables_match_the_study(shown, monkeypatch, capsys):
    study, _ = shown
    monkeypatch.setattr("vd4rl_pomdp.studies.theory.study.theory_study", lambda: study)
    main(["theory"])
    text = " ".join(capsys.readouterr().out.split())
    assert "16368 inverse examples" in text
    assert "Where the paper and enumeration differ: 10 facts" in text
    for row in table_rows(study):
        assert row["method"] in text
    for fact in study["facts"]:
        for words in (fact["title"], fact["printed"], fact["computed"]):
            assert words in text


def test_documentation_matches_the_study(shown):
    study, _ = shown
    text = (Path(__file__).parents[3] / "docs" / "theory.md").read_text()
    for row in table_rows(study):
        entries = [f"{printed} / {' '.join(computed)}" for printed, *computed in row["entries"].values()]
        assert f"| `{row['method']}` | {' | '.join(entries)} |" in text
    titles = dict.fromkeys(fact["title"] for fact in study["facts"])
    assert list(titles) == re.findall(r"^\d+\. \*\*(.*?)\.\*\*", text, re.MULTILINE)
    assert all(f"*{fact['world']}*" in text for fact in study["facts"] if fact["world"] != "counterexample")
    assert f"{len(study['differences'])} entries of Table 1 and of the paper's equations" in text
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    names: dict = {}
    exec(code.replace("print(", "found = ("), names)
    assert names["found"].decodes_past is False
