"""Verdicts on the paper's claims, on runs with given returns."""

import importlib
import re
from pathlib import Path
from typing import Any

import pytest
import scipy.stats

from tests.helpers_report import describe, on_own_sets, write_run, write_seeds
from vd4rl_pomdp.report.gates import CLAIMS, GATED, judge_claims, tally
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.page import print_summary, write_report
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import add_results, read_results

DATA = 600.0
GOOD = {
    ("state", "none"): (75, 77),
    ("acro", "none"): (60, 62),
    ("mik+a", "none"): (58, 60),
    ("acro", "patch"): (20, 22),
    ("mik", "patch"): (31, 33),
    ("mik+a", "patch"): (50, 54),
    ("random", "patch"): (10, 14),
    ("supervised+a", "patch"): (70, 71),
}
"""Scores (return / 10) of two seeds by method and corruption."""
MEMORY, GRU, ACTIONS, BOTH, OVER_AH, OVER_FJ, FIRST, CLEAN = (claim.text for claim in CLAIMS[1:9])


def write(folder: Path, scores: dict[tuple[str, str], tuple[float, ...]], **settings: Any) -> Path:
    return write_seeds(folder, scores, DATA, **settings)


def judged(folder: Path) -> dict[str, dict[str, Any]]:
    return {row["claim"]: row for row in judge_claims(load_runs([folder]))}


def test_claims_are_differences_of_means_with_intervals(tmp_path):
    rows = judged(write(tmp_path, GOOD))
    shown = {claim: (round(row["left_return"]), round(row["right_return"])) for claim, row in rows.items()}
    assert shown == {
        "acro returns less where pixels are hidden": (610, 210),
        "memory helps: mik above acro": (320, 210),
        "past actions help: mik+a above mik": (520, 320),
        "both help: mik+a above acro": (520, 210),
        "mik+a is above every other method": (520, 320),
        "with nothing hidden, mik+a is not below acro": (590, 610),
        "what a memory trained on the states adds": (705, 520),
        "what the states themselves add": (760, 520),
    }
    assert rows[ACTIONS]["difference"] == pytest.approx(200)
    found = scipy.stats.ttest_ind([500, 540], [310, 330], equal_var=False).confidence_interval(0.95)
    assert (rows[ACTIONS]["low"], rows[ACTIONS]["high"]) == pytest.approx(tuple(found))
    assert [row["verdict"] for row in rows.values()] == ["holds"] * 5 + ["not refuted", "", ""]


def test_episodes_are_paired_by_number(tmp_path):
    returns = {"mik": (30.0, 55.0, 41.0, 72.0), "acro": (44.0, 21.0, 63.0, 30.0)}
    for method, scores in returns.items():
        for seed in range(2):
            run = write_run(tmp_path / f"runs/{method}{seed}", method, seed, {10: [one + seed for one in scores]})
            describe(run, {"history": "method"}, seed=seed)
    add_results([tmp_path / "runs"], tmp_path / "rows")
    file = tmp_path / "rows" / "episodes.csv"
    before = judged(tmp_path / "rows")[MEMORY]
    head, *lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join([head, *sorted(lines, key=lambda line: float(line.split(",")[10]))]))
    assert [row["episode"] for row in read_results(tmp_path / "rows")[0].rows] == [1, 3, 0, 2], "sorted by return"
    assert judged(tmp_path / "rows")[MEMORY] == before


@pytest.mark.parametrize(
    ("changes", "claim", "verdict"),
    [
        ({("mik", "patch"): (21, 23)}, MEMORY, "undecided"),
        ({("mik", "patch"): (1, 3)}, MEMORY, "does not hold"),
        ({("mik", "patch"): (60,)}, MEMORY, "too few seeds"),
        ({("driml", "patch"): (80, 82)}, FIRST, "does not hold"),
        ({("random", "patch"): (80, 82)}, FIRST, "holds"),
        ({("driml", "patch"): (56,)}, FIRST, "too few seeds"),
        ({("driml", "patch"): (20,)}, FIRST, "too few seeds"),
        ({("driml", "patch"): (4, 59)}, FIRST, "undecided"),
        ({("mik+a", "patch"): (50, 50), ("mik", "patch"): (31, 31)}, ACTIONS, "too few seeds"),
        ({("driml", "patch"): (80, 82), ("fj+a", "patch"): (90,)}, FIRST, "does not hold"),
        ({("driml", "patch"): (50, 58), ("fj+a", "patch"): (40, 42)}, FIRST, "undecided"),
        ({("mik+a", "none"): (50, 52)}, CLEAN, "does not hold"),
        ({("mik+a", "none"): (50, 70)}, CLEAN, "not refuted"),
        ({("mik+a", "none"): (80, 82)}, CLEAN, "holds"),
        ({("acro", "none"): (60,)}, CLEAN, "too few seeds"),
    ],
)
def test_claim_verdict_follows_from_interval(tmp_path, changes, claim, verdict):
    assert judged(write(tmp_path, GOOD | changes))[claim]["verdict"] == verdict


def test_holm_correction_applies_within_claim_families(tmp_path):
    """Four primary contrasts, two of the second family, and an exploratory one without adjustment."""
    scores = {
        **{("acro", "patch"): (20, 22, 24), ("mik", "patch"): (27, 34, 33), ("mik+a", "patch"): (38, 44, 47)},
        **{("ah+a", "patch"): (33, 37, 36), ("fj+a", "patch"): (30, 31, 32), ("acro", "none"): (27, 31, 32)},
    }
    write(tmp_path, scores)
    rows = judged(write(tmp_path, {("acro", "patch"): (60, 64, 61)}, history="gru"))
    gru = {("gru", "patch"): (60, 64, 61)}

    def p(left, right, under="patch"):
        sides = ([10 * score for score in (scores | gru)[name]] for name in ((left, under), (right, "patch")))
        return scipy.stats.ttest_ind(*sides, equal_var=False).pvalue

    primary = {MEMORY: p("mik", "acro"), GRU: p("gru", "acro"), ACTIONS: p("mik+a", "mik"), BOTH: p("mik+a", "acro")}
    second = {OVER_AH: p("mik+a", "ah+a"), OVER_FJ: p("mik+a", "fj+a")}
    for family, values in (("primary", primary), ("second family", second)):
        assert {claim: row["p"] for claim, row in rows.items() if row["family"] == family} == pytest.approx(values)
        highest = 0.0
        for rank, claim in enumerate(sorted(values, key=values.get)):
            highest = max(highest, (len(values) - rank) * values[claim])
            assert rows[claim]["adjusted_p"] == pytest.approx(highest)
            assert rows[claim]["verdict"] == ("holds" if highest < 0.05 else "undecided")
    seen = rows["acro returns less where pixels are hidden"]
    assert (seen["family"], seen["adjusted_p"]) == ("exploratory", None)
    assert seen["p"] == pytest.approx(p("acro", "acro", "none"))
    assert (rows[MEMORY]["verdict"], seen["verdict"]) == ("undecided", "holds")
    assert rows[MEMORY]["p"] < 0.05 < rows[MEMORY]["adjusted_p"], "it would hold without adjustment"
    with_another = judge_claims(load_runs([write(tmp_path, scores, algorithm="iql")]))
    assert [row for row in with_another if row["algorithm"] == "td3_bc"] == [*rows.values()], "each setting by itself"


@pytest.mark.parametrize(("setting", "usual", "other"), [("updates", 10, 20), ("batch_size", None, 7)])
def test_every_budget_has_its_own_verdicts(tmp_path, setting, usual, other):
    """Even if returns differ: choosing the budget by returns would bias the contrast."""
    scores = {("acro", "patch"): (20, 22, 21), ("mik", "patch"): (31, 36, 32), ("mik+a", "patch"): (33, 41, 38)}
    twice = {("acro", "patch"): (45, 47, 46), ("mik", "patch"): (30, 60, 40), ("mik+a", "patch"): (60, 64, 63)}
    write(tmp_path / "one", scores)
    write(tmp_path / "two", twice)
    for run in (tmp_path / "two").iterdir():
        record = read_json(run / "config.json")
        usual = usual or record["config"][setting]
        write_json(run / "config.json", record | {"config": record["config"] | {setting: other}})
    both = judge_claims(load_runs([tmp_path]))
    for folder, value in (("one", usual), ("two", other)):
        alone = judge_claims(load_runs([tmp_path / folder]))
        mine = [row for row in both if f"{setting} {value}" in row["left"] and row["family"] == "primary"]
        assert len(mine) == 3
        for row, expected in zip(mine, (row for row in alone if row["family"] == "primary"), strict=True):
            for name in ("claim", "left_return", "right_return", "p", "adjusted_p", "verdict"):
                assert row[name] == expected[name]
    assert [row["verdict"] for row in both if row["claim"] == ACTIONS] == ["undecided", "undecided"]
    assert [row["verdict"] for row in both if row["claim"] == MEMORY] == ["holds", "undecided"]


def test_protocol_table_has_a_row_per_budget(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "tools")
    lines = importlib.import_module("protocol_table").contrast_lines
    scores = {("acro", "patch"): (20, 22, 21, 23), ("mik", "patch"): (31, 34, 32, 30)}
    for name, more in (("one", 0), ("two", 10)):
        write(tmp_path / name, scores | {("acro", "patch"): tuple(one + more for one in scores["acro", "patch"])})
        for run in (tmp_path / name).iterdir():
            record = read_json(run / "config.json")
            write_json(run / "config.json", record | {"config": record["config"] | {"updates": 10 + more}})
            rows = [row for row in read_episodes(run / "episodes.csv") if row["step"] == 10]
            clean = {"evaluated_under": "none", "return": 10.0 * (run.name.startswith("acro") + rows[0]["seed"])}
            append_episodes(run / "episodes.csv", [row | clean for row in rows])
    monkeypatch.setattr("protocol_table.unranked", lambda rows: [])
    *_, one, two = lines(load_runs([tmp_path]))
    assert "| walker_walk, expert, patch, 10 updates | `mik` minus `acro` | 4, 4 | 102 [" in one
    assert "| holds; opposite sign evaluated clean; depends on the budget |" in one
    assert ", 20 updates | `mik` minus `acro` | 4, 4 | 2 [" in two
    assert "| undecided; opposite sign evaluated clean; depends on the budget |" in two
    assert re.search(r"\| \d+ \(\d+%\) \|", one)
    *_, one, two = importlib.import_module("protocol_table").paired_lines(load_runs([tmp_path]))
    assert "| walker_walk, expert, patch, 10 updates | `mik` minus `acro` | 4 | 102 [" in one
    assert ", 20 updates | `mik` minus `acro` | 4 | 2 [" in two


def test_seeds_with_individual_sets_are_compared(tmp_path):
    on_own_sets(write(tmp_path / "one", GOOD), first=100)
    assert judged(tmp_path / "one")[BOTH]["verdict"] == "holds"
    on_own_sets(write(tmp_path / "two" / "acro", {("acro", "patch"): (20, 22)}), first=100)
    on_own_sets(write(tmp_path / "two" / "mik+a", {("mik+a", "patch"): (50, 54)}), first=200)
    assert judged(tmp_path / "two")[BOTH]["verdict"] == "not judged: other data"


def test_claims_include_clean_evaluations(tmp_path):
    """A claim may reverse when the same policies are evaluated without corruption."""
    write(tmp_path, GOOD)
    assert judged(tmp_path)[MEMORY]["clean_difference"] is None, "no clean evaluations yet"
    for method, score in (("mik", 10), ("acro", 50)):
        for seed in (0, 1):
            run = tmp_path / f"{method}-patch-{seed}-td3_bc"
            rows = [row for row in read_episodes(run / "episodes.csv") if row["step"] == 10]
            clean = {"evaluated_under": "none", "score": score + seed, "return": 10 * (score + seed)}
            append_episodes(run / "episodes.csv", [row | clean for row in rows])
    row = judged(tmp_path)[MEMORY]
    assert (row["verdict"], row["difference"]) == ("holds", pytest.approx(110))
    assert (row["clean_difference"], row["clean_low"] < row["clean_high"] < 0) == (pytest.approx(-400), True)
    assert "holds; opposite sign evaluated clean" in write_report([tmp_path], tmp_path / "out").page.read_text()


def test_claims_ignore_variants_of_methods(tmp_path):
    write(tmp_path, GOOD)
    write(tmp_path, {("acro", "patch"): (40, 42)}, history="gru")
    rows = judged(write(tmp_path, {("mik+a", "patch"): (90, 92)}, random_histories=0.5))
    assert rows[MEMORY]["right_return"] == pytest.approx(210)
    assert rows[ACTIONS]["left_return"] == pytest.approx(520)
    assert rows[GRU]["left_return"] == pytest.approx(410)
    assert "history gru" in rows[FIRST]["right"], "the best other method may be a variant"


def test_claims_compare_runs_of_equal_settings(tmp_path):
    write(tmp_path, GOOD)
    rows = judged(write(tmp_path, {("mik+a", "patch"): (90, 92), ("driml", "patch"): (95, 97)}, steps=60))
    assert (rows[ACTIONS]["left_return"], rows[ACTIONS]["right_return"]) == pytest.approx((520, 320))
    assert (rows[FIRST]["left_return"], rows[FIRST]["right_return"]) == pytest.approx((910, 960))


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"steps": 60, "max_k": 1}, "steps, max_k"), ({"steps": 60, "preset": "paper"}, "pretraining preset")],
)
def test_claims_without_equal_settings_are_not_judged(tmp_path, settings, words):
    write(tmp_path, GOOD | {("mik+a", "patch"): (), ("mik+a", "none"): ()})
    rows = judged(write(tmp_path, {("mik+a", "patch"): (90, 92)}, **settings))
    for claim in (ACTIONS, FIRST, "what a memory trained on the states adds"):
        row = rows[claim]
        assert (row["verdict"], row["difference"], row["low"]) == (f"not judged: other {words}", None, None)
        assert 910 in (round(row["left_return"]), round(row["right_return"])), "both sides are shown"
    assert rows[MEMORY]["verdict"] == "holds"
    states = rows["what the states themselves add"]
    assert (states["verdict"], states["difference"]) == ("", pytest.approx(760 - 910)), "states are not pretrained"


def test_seeds_that_share_an_encoder_are_excluded(tmp_path):
    write(tmp_path, GOOD | {("driml", "patch"): (80, 82)})
    for run in tmp_path.glob("driml-patch-*"):
        card = read_json(run / "encoder" / "config.json")
        write_json(run / "encoder" / "config.json", {"pretrain": card["pretrain"] | {"seed": 7}})
    assert judged(tmp_path)[FIRST]["right"] == "mik"


def test_unrecorded_history_counts_as_the_methods_default(tmp_path):
    for seed in (0, 1):
        describe(write_run(tmp_path / f"acro{seed}", "acro", seed, {10: [20.0 + seed]}), seed=seed)
    assert judged(tmp_path) == {}, "no acro with a GRU was run"


@pytest.mark.parametrize(("moved", "verdict"), [(0.05, "unconverged critic"), (None, "convergence is not recorded")])
def test_claims_require_converged_critics(tmp_path, moved, verdict):
    write(tmp_path, GOOD | {("mik", "patch"): ()})
    rows = judged(write(tmp_path, {("mik", "patch"): GOOD["mik", "patch"]}, moved=moved))
    for claim in (MEMORY, ACTIONS, FIRST):
        assert rows[claim]["verdict"] == f"not judged: {verdict}"
        assert rows[claim]["low"] < rows[claim]["difference"] < rows[claim]["high"], "the interval is still given"
    assert rows["acro returns less where pixels are hidden"]["verdict"] == "holds", "does not involve mik"


def test_claim_against_all_methods_requires_each_critic(tmp_path):
    write(tmp_path, GOOD)
    rows = judged(write(tmp_path, {("driml", "patch"): (20, 22)}, moved=0.05))
    assert (rows[FIRST]["right"], rows[FIRST]["verdict"]) == ("driml", "not judged: unconverged critic")


def test_page_and_terminal_show_claims(tmp_path, capsys):
    runs = write(tmp_path / "runs", GOOD | {("driml", "patch"): (60,)})
    report = write_report([runs], tmp_path / "out")
    page = report.page.read_text()
    row = judged(runs)[MEMORY]
    error, free = (200 / 2 + 200 / 2) ** 0.5, 2
    smallest = (scipy.stats.t.ppf(0.975, free) + scipy.stats.t.ppf(0.8, free)) * error
    assert (row["smallest"], row["smallest_share"]) == pytest.approx((smallest, smallest / DATA))
    for text in (
        "<h2>Claims</h2>",
        f"{MEMORY} (primary)",
        "mik+a: 520 (n = 2)",
        f"{row['p']:.3f} ({row['adjusted_p']:.3f})",
        f"{smallest:.0f} ({100 * smallest / DATA:.0f}%)",
    ):
        assert text in page
    assert (tmp_path / "out" / "claims.csv").exists()
    assert "400 [339, 461]" in (tmp_path / "out" / "claims.tex").read_text()
    print_summary(report)
    shown = " ".join(capsys.readouterr().out.split())
    assert f"{FIRST} (exploratory): holds in 0 of 1 setting; too few seeds in 1" in shown, "driml's one seed is higher"
    assert f"{ACTIONS} (primary): holds in 1 of 1 setting" in shown
    assert "trained on the states" not in shown, "distances have no verdict"


def test_tally_counts_unjudged_settings_by_reason():
    verdicts = ["not judged: other data", "undecided", "holds", "not judged: other data", "not judged: other readout"]
    rows = [{"kind": "above", "verdict": verdict} | dict.fromkeys(GATED, str(n)) for n, verdict in enumerate(verdicts)]
    assert tally(rows) == "holds in 1 of 5 settings; undecided in 1; not judged in 3 (2 other data, 1 other readout)"
    assert tally([rows[1], rows[2] | dict.fromkeys(GATED, "1")]) == "holds in 1 of 2 comparisons; undecided in 1"
