"""MIK+A's lead by pretraining budget, on runs with given returns."""

import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import scipy.stats

from tests.helpers_report import describe, on_own_sets, write_seeds
from vd4rl_pomdp.report.gates import leads
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.page import write_report

DATA = 800.0
LEAD, OVER_GRU = "mik+a minus acro", "mik+a minus acro with a GRU"


def write(folder: Path, steps: int, scores: dict[str, tuple[float, ...]], **policy: Any) -> None:
    """Write runs with `steps` of pretraining; `policy` holds fine-tuning settings."""
    for name, seeds in scores.items():
        method, _, gru = name.partition(" ")
        settings = {"steps": steps, "window": 32} | ({"history": "gru"} if gru else {})
        write_seeds(folder, {(method, "patch"): seeds}, DATA, **settings)
    for run in folder.glob(f"*-{steps}-*"):
        describe(run, **{"hidden_dim": 256} | policy)


@pytest.fixture
def runs(tmp_path) -> Path:
    """Two budgets; the larger one lacks acro with a GRU."""
    write(tmp_path / "runs", 3000, {"mik+a": (40, 44), "acro": (30, 38), "acro with a GRU": (20, 21)})
    write(tmp_path / "runs", 20000, {"mik+a": (70, 72), "acro": (30, 32)})
    return tmp_path / "runs"


def found(folder: Path) -> dict[tuple[str, int], dict[str, Any]]:
    return {(row["method"], row["steps"]): row for row in leads(load_runs([folder]))}


def test_lead_is_a_difference_of_return_shares_within_a_budget(runs):
    rows = found(runs)
    assert list(rows) == [(LEAD, 3000), (LEAD, 20000), (OVER_GRU, 3000), (OVER_GRU, 20000)]
    assert {row["stacks"] for row in rows.values()} == {8 * 32}
    *known, none = (row["difference"] for row in rows.values())
    assert (known, none) == (pytest.approx([10.0, 50.0, 26.875]), None), "percent of the data's return"
    ends = scipy.stats.ttest_ind([50, 55], [37.5, 47.5], equal_var=False).confidence_interval(0.95)
    first, missing = rows[LEAD, 3000], rows[OVER_GRU, 20000]
    assert (first["low"], first["high"]) == pytest.approx(tuple(ends))
    assert (missing["seeds"], missing["left_seeds"], missing["right_seeds"]) == (0, 2, 0)
    assert missing["low"] is None


def test_lead_uses_each_runs_own_data_return(runs):
    for run in runs.glob("*-1-td3_bc-20000-*"):
        (run / "reference.json").write_text((run / "reference.json").read_text().replace("800.0", "400.0"))
    assert found(runs)[LEAD, 20000]["difference"] == pytest.approx((87.5 + 180 - 37.5 - 80) / 2)


def test_leads_separate_finetuning_budgets(runs, tmp_path):
    for run in runs.glob("*-20000-*"):
        describe(run, hidden_dim=256, updates=500)
    assert found(runs) == {}, "each fine-tuning budget has only one pretraining budget"
    write(tmp_path / "more", 3000, {"mik+a": (50, 52), "acro": (40, 42)}, updates=500)
    rows = [row for row in leads(load_runs([runs, tmp_path / "more"])) if row["method"] == LEAD]
    assert [(row["updates"], row["steps"], round(row["difference"], 1)) for row in rows] == [
        (500, 3000, 12.5),
        (500, 20000, 50.0),
    ]
    write(tmp_path / "most", 20000, {"mik+a": (50, 52)})
    rows = leads(load_runs([runs, tmp_path / "more", tmp_path / "most"]))
    assert {row["variant"] for row in rows} == {"10 updates of 256 units", "500 updates of 256 units"}


def test_report_shows_leads_of_several_budgets(runs, tmp_path, figure_files):
    report = write_report([runs], tmp_path / "out")
    page = report.page.read_text()
    assert "<h2>Lead by pretraining budget</h2>" in page
    assert "3,000 x 256" in page
    table = pd.read_csv(tmp_path / "out" / "lead.csv")
    assert table["difference"].isna().tolist() == [False, False, False, True]
    assert (tmp_path / "out" / "figures" / "lead_patch.png").exists()
    one_budget = write_report(list(runs.glob("*-3000-*")), tmp_path / "one")
    assert "<h2>Lead" not in one_budget.page.read_text()
    assert not (tmp_path / "one" / "lead.csv").exists()


def test_leads_with_one_set_per_seed(runs):
    """One side may lack a seed."""
    on_own_sets(runs, first=100)
    assert found(runs)[LEAD, 3000]["difference"] == pytest.approx(10.0)
    shutil.rmtree(next(runs.glob("mik+a-patch-0-*-3000-*")))
    row = found(runs)[LEAD, 3000]
    assert (row["difference"], row["left_seeds"], row["low"]) == (pytest.approx(55 - 42.5), 1, None)
