"""Whether a setting can tell methods apart, on runs whose returns are given."""

from pathlib import Path
from typing import Any

import pytest

from tests.helpers_report import write_seeds
from vd4rl_pomdp.report import write_report
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.load import load_runs

DATA = 800.0
GOOD = {
    ("state", "patch"): (75, 77),
    ("acro", "none"): (60, 62),
    ("acro", "patch"): (20, 22),
    ("mik+a", "patch"): (50, 54),
    ("random", "patch"): (10, 14),
    ("supervised+a", "patch"): (70, 71),
}
"""Scores of two seeds of every method under a corruption: a tenth of their returns."""


def grid(folder: Path, scores: dict[tuple[str, str], tuple[float, ...]]) -> Path:
    return write_seeds(folder, scores, DATA)


def patch_gate(folder: Path) -> dict[str, Any]:
    (row,) = [row for row in gates(load_runs([folder])) if row["corruption"] == "patch"]
    return row


def test_a_setting_discriminates_if_state_acro_and_the_best_method_hold(tmp_path):
    row = patch_gate(grid(tmp_path, GOOD))
    assert row["verdict"] == "discriminates"
    assert row["data_return"] == DATA
    assert row["state_share"] == pytest.approx(760 / DATA)
    assert row["acro_share"] == pytest.approx(610 / DATA)
    assert row["above_random"] == pytest.approx(520 - 120), "the best that learned, not the ceiling"
    assert row["error"] == pytest.approx((800 / 2 + 800 / 2) ** 0.5)


def test_the_best_method_is_one_whose_seeds_tell_how_sure_it_is(tmp_path):
    row = patch_gate(grid(tmp_path, GOOD | {("mik", "patch"): (99,)}))
    assert (row["verdict"], row["above_random"]) == ("discriminates", pytest.approx(520 - 120))


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        (
            {("state", "patch"): (70, 71)},
            r"does not discriminate: state returns 0.88 of the data's return, less than 0.9",
        ),
        ({("acro", "none"): (55, 56)}, r"does not discriminate: acro under none returns 0.69 of the data's return"),
        ({("random", "patch"): (8, 90)}, r"does not discriminate: best minus random is 30, within 2 standard errors"),
        ({("state", "patch"): ()}, r"not known to discriminate: state was not measured"),
        ({("acro", "none"): ()}, r"not known to discriminate: acro under none was not measured"),
        ({("random", "patch"): (10,)}, r"not known to discriminate: best and random need two seeds each"),
        (
            {("random", "patch"): (10,), ("acro", "none"): (1, 1)},
            r"does not discriminate: acro under none returns 0.01",
        ),
    ],
)
def test_a_missed_gate_is_named_and_what_was_not_measured_too(tmp_path, changes, verdict):
    found = patch_gate(grid(tmp_path, GOOD | changes))["verdict"]
    assert found.startswith(verdict)


def test_methods_of_a_setting_that_does_not_discriminate_are_listed_by_name(tmp_path):
    runs = grid(tmp_path / "runs", GOOD | {("state", "patch"): (9, 9)})
    report = write_report([runs], tmp_path / "out")
    assert ("walker_walk", "expert", "patch") in unranked(report.gates)
    names = [row["method"] for row in report.summary if row["corruption"] == "patch"]
    assert names == ["acro", "mik+a", "random", "state", "supervised+a"]
    text = report.page.read_text()
    assert text.index("does not discriminate: state returns") < text.index("Final scores")
    ranked = write_report([grid(tmp_path / "good", GOOD)], tmp_path / "other")
    assert next(row["method"] for row in ranked.summary if row["corruption"] == "patch") == "mik+a"
