"""`report compare`: two result sets side by side."""

import csv
from pathlib import Path

import pytest
import scipy.stats

from tests.helpers_bad_input import rejection
from tests.helpers_report import describe, write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.report.compare import compare_results
from vd4rl_pomdp.runs.results import add_results


def two_sets(folder: Path) -> tuple[Path, Path]:
    """Two seeds of acro in both, pretrained longer in B; mik+a only in A, curl only in B."""
    for seed in (0, 1):
        describe(write_run(folder / f"a/acro{seed}", "acro", seed, {5: [90.0], 10: [20.0 + seed]}), {})
        describe(write_run(folder / f"b/acro{seed}", "acro", seed, {10: [26.0 + seed]}), {"steps": 60}, views=1)
        describe(write_run(folder / f"a/mik{seed}", "mik+a", seed, {10: [30.0]}), {})
    describe(write_run(folder / "b/curl", "curl", 0, {10: [50.0]}), {})
    (describe(write_run(folder / "b/late", "curl", 1, {10: [99.0]}), {}) / "timing.json").unlink()
    return folder / "a", folder / "b"


def test_compare_lists_conditions_with_differing_settings(tmp_path):
    found = compare_results(*two_sets(tmp_path))
    acro, curl, mik = found.rows
    assert (acro["score_a"], acro["score_b"], acro["difference"]) == (20.5, 26.5, 6.0)
    welch = scipy.stats.ttest_ind([26, 27], [20, 21], equal_var=False).confidence_interval(0.95)
    assert (acro["low"], acro["high"]) == pytest.approx(tuple(welch))
    assert (acro["seeds_a"], acro["seeds_b"]) == (2, 2)
    assert (acro["low_a"], acro["high_a"]) == pytest.approx((14.147, 26.853), abs=0.001), "12.7 standard errors"
    assert acro["settings"] == "views 4 → 1, steps 20 → 60"
    assert (curl["score_a"], curl["score_b"], curl["seeds_b"], curl["difference"]) == (None, 50.0, 1, None)
    assert (mik["score_a"], mik["score_b"], mik["settings"]) == (30.0, None, "")
    assert [side["others"] for side in found.sides] == [0, 1], "an unfinished run has no score"


def test_comparing_a_set_with_itself_shows_no_difference(tmp_path):
    runs, _ = two_sets(tmp_path)
    add_results([runs], tmp_path / "rows")
    for row in compare_results(runs, tmp_path / "rows").rows:
        assert (row["difference"], row["low"], row["high"], row["settings"]) == (0.0, None, None, "")
        assert row["score_a"] == row["score_b"]


def test_sets_that_share_runs_are_not_compared_as_independent_samples(tmp_path, capsys):
    a, b, c = (tmp_path / name for name in "abc")
    for folder, seeds in ((a, (0, 1, 2)), (b, (1, 2, 3)), (c, (3, 4))):
        for seed in seeds:
            describe(write_run(folder / str(seed), "acro", seed, {10: [20.0 + seed]}), {})
    (row,) = compare_results(a, b).rows
    assert (row["difference"], row["low"], row["high"], row["shared"]) == (1.0, None, None, 2)
    main(["report", "compare", str(a), str(b), "--out", str(tmp_path / "out")])
    line = "No interval where a run is in both sets"
    shown = " ".join(capsys.readouterr().out.split())
    assert line in shown
    assert "3 | 3, 2 in both" in shown
    assert line in (tmp_path / "out" / "index.html").read_text()
    (row,) = compare_results(a, c).rows
    welch = scipy.stats.ttest_ind([23, 24], [20, 21, 22], equal_var=False).confidence_interval(0.95)
    assert (row["shared"], row["low"], row["high"]) == (0, *map(pytest.approx, welch))
    main(["report", "compare", str(a), str(c)])
    assert line not in " ".join(capsys.readouterr().out.split())


def test_variants_are_matched_by_name_or_as_single_candidates(tmp_path):
    for k in (1, 15):
        describe(write_run(tmp_path / f"a/{k}", "mik+a", 0, {10: [k]}), {"max_k": k})
        describe(write_run(tmp_path / f"b/{k}", "mik+a", 0, {10: [2.0 * k]}), {"max_k": k})
    both = compare_results(tmp_path / "a", tmp_path / "b").rows
    assert {row["variant"]: row["difference"] for row in both} == {"max_k 1": 1.0, "max_k 15": 15.0}
    lone = compare_results(tmp_path / "a" / "15", tmp_path / "b" / "1").rows
    assert [(row["difference"], row["settings"]) for row in lone] == [(-13.0, "max_k 15 → 1")]
    some = compare_results(tmp_path / "a", tmp_path / "b" / "1").rows
    assert {row["variant"]: row["difference"] for row in some} == {"max_k 1": 1.0, "max_k 15": None}
    describe(write_run(tmp_path / "c", "mik+a", 0, {10: [9.0]}), {"max_k": 30})
    other = compare_results(tmp_path / "a", tmp_path / "c").rows
    assert [row["difference"] for row in other] == [None] * 3, "two candidates are ambiguous"


def test_equal_settings_match_under_different_labels(tmp_path):
    for size in (16, 48):
        for seed in (0, 1):
            run = write_run(tmp_path / f"a/{size}/{seed}", "acro", seed, {10: [size + seed]})
            describe(run, {"patch_size": size})
    rows = compare_results(tmp_path / "a", tmp_path / "a" / "16").rows
    found = {row["corruption"]: (row["difference"], row["seeds_a"], row["seeds_b"]) for row in rows}
    assert found == {"patch, patch_size 16": (0.0, 2, 2), "patch, patch_size 48": (None, 2, 0)}
    back = compare_results(tmp_path / "a" / "16", tmp_path / "a").rows
    assert [row["difference"] for row in back if row["corruption"] == "patch"] == [0.0]


def test_compare_command_prints_and_writes_page(tmp_path, capsys):
    a, b = two_sets(tmp_path)
    main(["report", "compare", str(a), str(b), "--out", str(tmp_path / "out")])
    shown = capsys.readouterr().out
    assert "only in A" in shown
    assert f"comparison: {tmp_path / 'out' / 'index.html'}" in shown
    page = (tmp_path / "out" / "index.html").read_text()
    for text in ("<td>acro</td>", "<td>6.0 [3.0, 9.0]</td>", "2 | 2", "steps 20 → 60", "only in B", str(a)):
        assert text in page
    with (tmp_path / "out" / "comparison.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["acro", "curl", "mik+a"]
    assert r"steps 20 $\rightarrow$ 60" in (tmp_path / "out" / "comparison.tex").read_text()
    with pytest.raises(SystemExit):
        main(["report", "compare", "--help"])
    assert "report compare" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a"], "error: "),
        (["a", "nowhere"], "nowhere: no such folder"),
        (["a", "b/late"], "late: holds no finished and evaluated run to compare"),
        (["a", "b", "--out", "a"], "choose another --out"),
    ],
)
def test_invalid_comparisons_are_rejected(tmp_path, monkeypatch, words, message):
    two_sets(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert message in rejection(["report", "compare", *words])
