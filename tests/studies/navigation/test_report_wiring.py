"""The navigation report shows the number that its titles name: all numbers of its runs differ here."""

import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.studies.navigation.test_report import loaded, write_run
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.report import claims, judge, make_tables, write_report
from vd4rl_pomdp.studies.navigation.runs import (
    OBJECTIVES,
    RAW_PREFIX,
    REFERENCES,
    Condition,
    Measure,
    held_out_loss,
    numbers_of,
    online_error,
    paper_number,
    refitted_error,
)

MAZE = "three_curtains"
CONDITIONS = [
    *(Condition(MAZE, method) for method in (*OBJECTIVES, *REFERENCES)),
    *(Condition(MAZE, method, 1) for method in ("ah+a", "mik+a")),
    Condition(MAZE, "mik+a", 1, literal_future=True),
]
PARTS = ("state", "position", "velocity")


def value(condition: Condition, measure: Measure, seed: int = 1) -> float:
    """A number of its own for everything that a report shows; the mean over the seeds 0 to 2 is that of seed 1."""
    if measure.measure == "action_loss":
        place = 10 + 3 * measure.k + 100 * (measure.split == "training")
    else:
        place = 1 + PARTS.index(measure.measure.removeprefix(RAW_PREFIX).removesuffix("_error"))
        place += 10 * (measure.split == "training") + 20 * (measure.rows == "hidden") + 50 * measure.is_raw
    return place + 200 * CONDITIONS.index(condition) + 0.25 * seed


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Three seeds of all objectives and references in one maze; tests must not write here."""
    base = tmp_path_factory.mktemp("navigation") / "runs"
    for condition in CONDITIONS:
        for seed in (0, 1, 2):
            file = write_run(base, condition, seed, 1.0) / "results.json"
            found = json.loads(file.read_text())
            for row in found["rows"]:
                row["value"] = value(condition, Measure(*(row[name] for name in Measure._fields)), seed)
            file.write_text(json.dumps(found))
    return base


def test_cells_hold_the_numbers_of_their_titles(runs):
    cells = make_tables(loaded(runs))
    cells = cells[cells["maze"] == MAZE]

    def of(table: str, view: str, row: str) -> float:
        here = cells[(cells["table"] == table) & (cells["row"] == row) & cells["view"].str.contains(view, regex=False)]
        ((mean, low, high),) = here[["mean", "low", "high"]].to_numpy()
        assert (mean - low, high - mean) == pytest.approx((0.25 * 4.30265 / 3**0.5,) * 2, rel=1e-4), "t, 2 degrees"
        return mean

    mik_a, ours = Condition(MAZE, "mik+a"), "training averages, probe trained beside the model"
    for unit, percent in (("% of a standard deviation", True), ("raw units x 100", False)):
        for view, measure in ((f"{ours} (the paper's way); {unit}", online_error), ("frozen states; " + unit, None)):
            for part in PARTS:
                wanted = (measure or refitted_error)(part)
                wanted = wanted if percent else wanted.raw()
                assert of(f"{part}_error", view, "MIK+A, K=15") == value(mik_a, wanted)
    assert of("action_loss", "the paper's way", "MIK+A, K=15") == value(mik_a, Measure("action_loss", "training", ""))
    assert of("action_loss", "held-out", "MIK+A, K=15") == value(mik_a, held_out_loss())
    for k in (1, 5, 15):
        assert of("by_k", "held-out", f"mik+a, k={k}") == value(mik_a, held_out_loss(k))
    literal = CONDITIONS[-1]
    assert of("references", "% of", "MIK+A, literal future, K=1, state error") == value(
        literal, refitted_error("state")
    )
    for part in PARTS:
        assert of("references", "% of", f"random, {part}") == value(Condition(MAZE, "random"), refitted_error(part))
    for part in PARTS[1:]:
        assert of("hidden", "% of", f"mik+a, {part}") == value(mik_a, refitted_error(part, "hidden"))


def test_claims_compare_the_numbers_of_their_texts(runs):
    numbers = numbers_of(loaded(runs))
    words = {claim.text: judge(claim, numbers)[1][0] for claim in claims(MAZE)}

    def pair(*sides: tuple[Condition, Measure]) -> str:
        return " / ".join(f"{value(*side):.1f}" for side in sides)

    def refitted(method: str, part: str, k: int = 15) -> tuple[Condition, Measure]:
        return Condition(MAZE, method, k), refitted_error(part)

    mik_a, best = Condition(MAZE, "mik+a"), refitted("mik+a", "state", 1)
    for text, sides in {
        "gate: mik+a's action loss at k=1, of that at k=15": [(mik_a, held_out_loss(k)) for k in (1, 15)],
        "no_history's velocity error, of mik+a's": [refitted(one, "velocity") for one in ("no_history", "mik+a")],
        "K=1: ah+a's state error, of mik+a's": [refitted("ah+a", "state", 1), best],
        "K=1: ah+a's action loss is near zero": [(Condition(MAZE, "ah+a", 1), held_out_loss())],
        "K=1: mik+a's state error with the literal future, of the default's": [
            (CONDITIONS[-1], refitted_error("state")),
            best,
        ],
        "ah+a's position error, of mik+a's": [refitted(one, "position") for one in ("ah+a", "mik+a")],
        "mik's velocity error, of mik+a's": [refitted(one, "velocity") for one in ("mik", "mik+a")],
        "ah's state error, of mik+a's": [refitted(one, "state") for one in ("ah", "mik+a")],
    }.items():
        assert words[text] == pair(*sides), text


def test_page_and_rows_are_of_all_seeds(runs, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "accuracy_bars", lambda runs, measure, path: drawn.append((path.name, measure)))
    monkeypatch.setattr(figures, "trajectories", lambda *_: False)
    page = write_report([runs], tmp_path / "out").read_text()
    assert f"Runs: {3 * len(CONDITIONS)}. Preset: `cpu`. Seeds: 0, 1, 2. Budget: 2,500 gradient steps" in page
    assert page.count(f"  # {MAZE}, 300 s\n") == 3 * len(CONDITIONS)
    state = refitted_error("state")
    assert drawn == [("accuracy.png", state), ("accuracy_raw.png", state.raw())]
    with (tmp_path / "out" / "rows.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            flags = (row[name] == "1" for name in Condition._fields[3:])
            condition = Condition(row["maze"], row["method"], int(row["max_k"]), *flags)
            measure = Measure(row["measure"], row["split"], row["probe"], row["rows"], int(row["k"]))
            assert float(row["value"]) == pytest.approx(value(condition, measure, int(row["seed"])), rel=1e-5)


@pytest.fixture
def drawn(monkeypatch) -> list:
    """Figures instead of their files."""
    found = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *_, **__: found.append(figure))
    return found


def test_bars_are_mean_accuracies_beside_the_papers(runs, tmp_path, drawn):
    error = refitted_error("state").raw()
    figures.accuracy_bars(loaded(runs), error, tmp_path / "bars.png")
    (axes,) = drawn[0].axes
    known = [one for one in CONDITIONS if not one.literal_future]
    heights = sorted(bar.get_height() for bar in axes.patches)
    assert heights == pytest.approx(sorted(100 - value(condition, error) for condition in known))
    place = [*OBJECTIVES, *REFERENCES].index("mik+a")
    bars = {round(bar.get_x() + bar.get_width() / 2 - place, 2): bar.get_height() for bar in axes.patches}
    short, long = (Condition(MAZE, "mik+a", k) for k in (1, 15))
    assert (bars[-0.27], bars[0.0]) == pytest.approx((100 - value(short, error), 100 - value(long, error)))
    marks = {round(line.get_xdata()[0], 2): line.get_ydata()[0] for line in axes.lines if line.get_marker() == "_"}
    assert marks[place] == pytest.approx(100 - paper_number(long, error))


def test_trajectories_name_truth_and_estimate(tmp_path, drawn):
    file = write_run(tmp_path, Condition(MAZE, "mik+a"), 0, 1.0) / "trajectory.csv"
    assert figures.trajectories(loaded(tmp_path), tmp_path / "trajectories.png")
    lines, table = {line.get_label(): line.get_xydata() for line in drawn[0].axes[0].lines}, pd.read_csv(file)
    np.testing.assert_array_equal(lines["true"], table[["x", "y"]])
    np.testing.assert_array_equal(lines["probe"], table[["estimated_x", "estimated_y"]])
