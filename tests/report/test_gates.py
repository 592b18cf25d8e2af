"""Gates that decide whether a setting discriminates between methods, on runs with given returns."""

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import scipy.stats

from tests.helpers_report import describe, write_seeds
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report.gates import gates, unranked
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.page import print_summary, write_report
from vd4rl_pomdp.runs.files import write_json

DATA = 800.0
GOOD = {
    ("state", "patch"): (75, 77),
    ("acro", "none"): (66, 68),
    ("acro", "patch"): (20, 22),
    ("mik+a", "patch"): (50, 54),
    ("random", "patch"): (10, 14),
    ("supervised+a", "patch"): (70, 71),
}
"""Scores (return / 10) of two seeds by method and corruption."""
UNDECIDED, UNKNOWN = "undecided at this budget", "not known to discriminate"
ABOVE_RANDOM = tuple(scipy.stats.ttest_ind([500, 540], [100, 140]).confidence_interval(0.95))


def grid(folder: Path, scores: dict[tuple[str, str], tuple[float, ...]], **settings: Any) -> Path:
    return write_seeds(folder, scores, DATA, **settings)


def gate(folder: Path, corruption: str) -> dict[str, Any]:
    (row,) = [row for row in gates(load_runs([folder])) if row["corruption"] == corruption]
    return row


def move(folder: Path, method: str, corruption: str, moved: float | None) -> None:
    """Set the relative movement of the critics of a method's runs."""
    for run in folder.glob(f"{method}-{corruption}-*"):
        write_json(run / "critic.json", {"value": 150.0, "moved": moved, "data": 160.0})


def methods(summary: pd.DataFrame) -> list[str]:
    """Methods of the setting with patches, in order."""
    return summary.loc[summary["corruption"] == "patch", "method"].tolist()


def patch_gate(folder: Path) -> dict[str, Any]:
    return gate(folder, "patch")


def test_setting_discriminates_if_all_gates_pass(tmp_path):
    row = patch_gate(grid(tmp_path, GOOD))
    assert row["verdict"] == "discriminates"
    assert row["data_return"] == DATA
    assert row["state_share"] == pytest.approx(760 / DATA)
    assert row["acro_share"] == pytest.approx(670 / DATA)
    assert row["best_share"] == pytest.approx(520 / DATA), "best method, excluding the supervised ceiling"
    assert row["above_random"] == pytest.approx(520 - 120)
    assert (row["low"], row["high"]) == pytest.approx(ABOVE_RANDOM)
    assert (row["state_seeds"], row["acro_seeds"]) == (2, 2)


def test_best_method_needs_two_seeds(tmp_path):
    row = patch_gate(grid(tmp_path, GOOD | {("mik", "patch"): (99,)}))
    assert (row["verdict"], row["above_random"]) == ("discriminates", pytest.approx(520 - 120))


def test_gates_exclude_variants(tmp_path):
    grid(tmp_path, GOOD | {("state", "patch"): ()})
    grid(tmp_path, {("state", "patch"): (75, 77)}, pose_noise=34)
    grid(tmp_path, {("mik", "patch"): (90, 92)}, history="lru")
    row = patch_gate(grid(tmp_path, {("random", "patch"): (49,)}, history="gru"))
    assert row["verdict"] == "not known to discriminate: state was not measured"
    assert (row["above_random"], row["low"]) == pytest.approx((520 - 120, ABOVE_RANDOM[0]))


def test_best_method_is_compared_with_random_of_equal_finetuning(tmp_path):
    grid(tmp_path, GOOD | {("random", "patch"): ()})
    grid(tmp_path, {("random", "patch"): (10, 14)}, steps=0)
    assert patch_gate(tmp_path)["verdict"] == "discriminates", "random is not pretrained, so steps do not matter"
    for run in tmp_path.glob("random-*"):
        describe(run, updates=500)
    row = patch_gate(tmp_path)
    assert row["verdict"] == "not known to discriminate: best and random have other updates"
    assert (row["above_random"], row["low"]) == (None, None)
    for run in tmp_path.glob("acro-patch-*"):
        describe(run, updates=500)
    assert patch_gate(tmp_path)["above_random"] == pytest.approx(210 - 120), "best method with equal updates"


def test_single_reference_seed_counts_if_alone(tmp_path):
    lone = GOOD | {("acro", "none"): (60,)}
    assert patch_gate(grid(tmp_path / "lone", lone))["acro_share"] == pytest.approx(600 / DATA)
    grid(tmp_path / "lucky", GOOD | {("acro", "none"): (55, 56)})
    row = patch_gate(grid(tmp_path / "lucky", {("acro", "none"): (99,)}, steps=60))
    assert row["acro_share"] == pytest.approx(555 / DATA)


def test_state_reference_counts_each_seed_once(tmp_path):
    grid(tmp_path, GOOD | {("state", "none"): (9, 11, 40)})
    assert gate(tmp_path, "none")["state_share"] == pytest.approx(200 / DATA)
    assert patch_gate(tmp_path)["state_share"] == pytest.approx((750 + 770 + 400) / 3 / DATA)


def test_references_are_divided_by_their_own_data_return(tmp_path):
    grid(tmp_path, GOOD | {("state", "patch"): ()})
    row = patch_gate(write_seeds(tmp_path, {("state", "patch"): (75, 77)}, 400.0))
    assert (row["state_share"], row["acro_share"]) == (pytest.approx(760 / 400), pytest.approx(670 / DATA))
    assert row["data_return"] == pytest.approx((DATA + 400) / 2)


@pytest.mark.parametrize(("data", "words"), [(None, "not known"), (-1000.0, "not above 0"), (0.0, "not above 0")])
def test_gates_need_a_positive_data_return(tmp_path, data, words):
    row = patch_gate(write_seeds(tmp_path, GOOD, data))
    assert row["data_return"] == data
    assert (row["state_share"], row["acro_share"], row["best_share"]) == (None, None, None)
    assert row["verdict"] == f"not known to discriminate: the data's return is {words}"


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({("state", "patch"): (70, 71)}, f"{UNDECIDED}: state returns 0.88 of the data's return, less than 0.9"),
        (
            {("acro", "none"): (63, 64)},
            f"{UNDECIDED}: acro under none returns 0.79 of the data's return, less than 0.80",
        ),
        ({("random", "patch"): (8, 90)}, f"{UNDECIDED}: best minus random is 30 [-"),
        ({("state", "patch"): ()}, f"{UNKNOWN}: state was not measured"),
        ({("acro", "none"): ()}, f"{UNKNOWN}: acro under none was not measured"),
        ({("random", "patch"): (10,)}, f"{UNKNOWN}: best and random need two seeds each"),
        ({("random", "patch"): ()}, f"{UNKNOWN}: random was not measured"),
        ({("acro", "patch"): (), ("mik+a", "patch"): ()}, f"{UNKNOWN}: no method but references was measured"),
        ({("random", "patch"): (10,), ("acro", "none"): (1, 1)}, f"{UNDECIDED}: acro under none returns 0.01"),
    ],
)
def test_verdict_names_failed_and_unmeasured_gates(tmp_path, changes, verdict):
    found = patch_gate(grid(tmp_path, GOOD | changes))["verdict"]
    assert found.startswith(verdict)


@pytest.mark.parametrize(
    ("task", "quality", "data", "share", "source"),
    [
        ("cheetah_run", "expert", 864.6, 0.8 * 674 / 864.6, "BC 67.4"),
        ("walker_walk", "expert", 942.7, 0.8 * 915 / 942.7, "BC 91.5"),
        ("walker_walk", "medium_expert", 706.0, 0.8, "DrQ+BC 86.4"),
        ("humanoid_walk", "expert", 844.8, 0.8 * 61 / 844.8, "BC 6.1"),
        ("humanoid_walk", "medium", 416.7, 0.8 * 135 / 416.7, "BC 13.5"),
        ("humanoid_walk", "medium_expert", 630.6, 0.8 * 172 / 630.6, "BC 17.2"),
        ("walker_walk", "expert_noisy", 664.0, 0.7, "none published"),
    ],
)
def test_pixel_gate_follows_published_returns(tmp_path, task, quality, data, share, source):
    """As shares of the data's return."""
    of_set = {"task": task, "quality": quality}
    for name, factor in (("just", 1.001), ("not", 0.999)):
        write_seeds(tmp_path / name, {("acro", "none"): (share * data * factor / 10,)}, data, of_set=of_set)
        row = gate(tmp_path / name, "none")
        assert (row["acro_bar"], row["bar_from"]) == (pytest.approx(share), source)
        assert row["verdict"].startswith("not known" if name == "just" else "undecided at this budget: acro under none")


def test_gate_threshold_averages_over_the_data_of_runs(tmp_path):
    """A set that returns less than the published score has the threshold 0.8."""
    write_seeds(tmp_path, {("acro", "none"): (70, 70)}, 1000.0)
    Reference(600.0).write(tmp_path / "acro-none-1-td3_bc")
    row = gate(tmp_path, "none")
    assert (row["acro_bar"], row["acro_seeds"]) == (pytest.approx(0.8 * (0.915 + 1) / 2), 2)


MOVED = {("acro", "none"): "acro under none", ("mik+a", "patch"): "best", ("random", "patch"): "random"}
MOVED |= {("state", "patch"): "state"}


@pytest.mark.parametrize("who", MOVED)
@pytest.mark.parametrize("moved", [0.021, -0.021])
def test_unconverged_critic_leaves_setting_undecided(tmp_path, who, moved):
    grid(tmp_path, GOOD)
    move(tmp_path, *who, moved)
    row = patch_gate(tmp_path)
    assert row["verdict"] == f"undecided at this budget: critics had not converged ({MOVED[who]})"
    assert row["converged"] is False
    move(tmp_path, *who, moved / 1.06)
    assert patch_gate(tmp_path)["verdict"] == "discriminates"


@pytest.mark.parametrize(("method", "words"), [("random", "random"), ("mik+a", "best")])
def test_critic_without_a_partner_counts(tmp_path, method, words):
    """Where only one side of the third gate was measured, its critic is still one of the setting's."""
    grid(tmp_path, {name: seeds for name, seeds in GOOD.items() if name in (("state", "patch"), (method, "patch"))})
    move(tmp_path, method, "patch", 0.0222)
    row = patch_gate(tmp_path)
    assert row["converged"] is False
    assert row["verdict"] == f"undecided at this budget: critics had not converged ({words})"


def test_unused_critics_do_not_affect_verdict(tmp_path):
    grid(tmp_path, GOOD)
    move(tmp_path, "acro", "patch", 0.5)
    row = patch_gate(tmp_path)
    assert (row["verdict"], row["converged"]) == ("discriminates", True)


def test_unrecorded_convergence_is_unknown(tmp_path):
    row = patch_gate(grid(tmp_path / "early", GOOD, moved=None))
    assert row["verdict"] == "not known to discriminate: convergence is not recorded"
    assert row["converged"] is None
    grid(tmp_path / "short", GOOD)
    move(tmp_path / "short", "state", "patch", None)  # too few rows of metrics
    assert patch_gate(tmp_path / "short")["verdict"] == row["verdict"]
    missed = patch_gate(grid(tmp_path / "missed", GOOD | {("acro", "none"): (1, 1)}, moved=None))["verdict"]
    assert missed == "undecided at this budget: acro under none returns 0.01 of the data's return, less than 0.80"


@pytest.mark.parametrize(("algorithm", "record"), [("bc", None), ("mine", {})])
def test_algorithms_without_critic_need_no_convergence(tmp_path, algorithm, record):
    grid(tmp_path, GOOD, algorithm=algorithm, moved=None)
    for run in tmp_path.iterdir() if record is not None else ():
        write_json(run / "critic.json", record)
    assert patch_gate(tmp_path)["verdict"] == "discriminates"


def test_undecided_settings_are_not_ranked(tmp_path):
    runs = grid(tmp_path / "runs", GOOD | {("state", "patch"): (9, 9)})
    report = write_report([runs], tmp_path / "out")
    assert ("walker_walk", "expert", "patch", "td3_bc") in unranked(report.gates)
    assert methods(report.summary) == ["acro", "mik+a", "random", "state", "supervised+a"]
    for name in ("representations", "control"):
        assert methods(pd.read_csv(tmp_path / "out" / f"{name}.csv")) == methods(report.summary)
    text = report.page.read_text()
    assert text.index("undecided at this budget: state returns") < text.index("Final scores")
    ranked = write_report([grid(tmp_path / "good", GOOD)], tmp_path / "other")
    assert methods(ranked.summary)[0] == "mik+a"
    for algorithm in ("td3_bc", "iql"):
        grid(tmp_path / "both", GOOD | {("acro", "none"): (9, 9)}, algorithm=algorithm)
    assert methods(write_report([tmp_path / "both"], tmp_path / "last").summary)[:3] == ["acro", "acro", "mik+a"]


def test_gates_are_separate_per_algorithm(tmp_path, capsys):
    grid(tmp_path / "runs", GOOD)
    grid(tmp_path / "runs", GOOD | {("acro", "none"): (9, 9)}, algorithm="iql")
    report = write_report([tmp_path / "runs"], tmp_path / "out")
    assert {place[3] for place in unranked(report.gates)} == {"iql"}
    verdicts = {(row["algorithm"], row["verdict"]) for row in report.claims if row["verdict"]}
    assert verdicts == {("iql", "not judged: undecided at this budget"), ("td3_bc", "holds")}
    assert methods(report.summary)[0] == "mik+a", "one algorithm can be ranked"
    print_summary(report)
    for shown in (re.sub(r"</td>\s*<td>", ": ", report.page.read_text()), " ".join(capsys.readouterr().out.split())):
        assert "walker_walk expert, patch, iql: undecided at this budget: acro under none" in shown
        assert "walker_walk expert, patch: discriminates" in shown
