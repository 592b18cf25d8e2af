"""Runs belong to a grid by their settings and datasets, wherever they were made."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_report import finished_result
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.data.collect import CollectConfig, collection
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.results import read_results, write_results
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers
from vd4rl_pomdp.sweeps.stages import collection_of, recorded

EARLIER = Path(__file__).parents[2] / "results" / "earlier"
PAGE = Path(__file__).parents[2] / "docs" / "sweeps.md"
GRID = """
seed = [0, 1]
preset = "smoke"
[collect]
task = "walker_walk"
quality = "expert"
episodes = 3
[pretrain]
method = ["mik+a", "acro"]
corruption = "patch"
[finetune]
eval_episodes = 1
"""


@pytest.fixture
def grid(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    return tmp_path / "grid.toml"


@pytest.fixture
def runs(grid):
    """Fine-tuning runs of the grid's cells, on a collected dataset."""
    made = []
    for cell in load_grid(str(grid)).cells():
        labels = {name: cell.value(name) for name in ("method", "task", "quality", "corruption", "seed")}
        run = finished_result(grid.parent, labels | {"algorithm": "td3_bc"})
        before = recorded(cell, "pretrain")
        card = {"settings": settings_of(before), "seed": cell.seed, "data": "here"}
        record = run.record | {"format": FORMAT, "config": recorded(cell, "finetune")}
        record |= {"inputs": {"data": "here"}, "collection": collection_of(cell)}
        made.append(replace(run, id=f"{labels}", files=run.files | {"config": record, "encoder": {"pretrain": card}}))
    return made


def members(grid, runs, *changes):
    return GridMembers("grid", load_grid(str(grid), changes).cells()).among(runs)


def changed(run, **record):
    return replace(run, files=run.files | {"config": run.record | record})


def test_runs_with_settings_of_cells_are_members(grid, runs):
    assert members(grid, runs) == runs
    assert members(grid, runs, "seed=1", "pretrain.method=acro") == [runs[3]]
    with pytest.raises(UserError, match=r"^none of 4 runs is one of the 4 cells of grid that are asked for"):
        members(grid, runs, "pretrain.corruption=none")


def test_members_match_datasets_by_collection(grid, runs):
    other = collection(CollectConfig(task="walker_walk", quality="expert", episodes=4, out=Path()))
    elsewhere = {"inputs": {"data": "elsewhere"}}
    twin = replace(runs[2], files=runs[2].files | {"encoder": {"pretrain": runs[2].card | {"data": "elsewhere"}}})
    own = [runs[0], changed(twin, **elsewhere)]
    # the second member has other content but an equal collection; the others differ in collection or encoder
    assert members(grid, [*own, changed(runs[1], collection=other), changed(runs[3], **elsewhere)]) == own


def test_uncollected_datasets_match_by_name(grid, runs):
    downloaded = [changed(run, collection={}) for run in runs]
    assert members(grid, downloaded) == downloaded
    with pytest.raises(UserError, match="none of 4 runs"):
        members(grid, downloaded, "collect.quality=medium")


def test_offline_page_counts_its_cells():
    cells = load_grid("offline").cells()
    own, control = read_results(EARLIER / "offline"), read_results(EARLIER / "control")
    found = GridMembers("offline", cells).among([*own, *control])
    assert found[: len(own)] == own
    assert {run.record["config"]["update_precision"] for run in found} == {"bf16"}
    assert {run.encoder["settings"]["history"] for run in found if run.encoder} == {"method"}
    page = (EARLIER / "README.md").read_text()
    measured, asked = re.search(r"(\d+) of the (\d+) cells of the grid", page).groups()
    assert (int(measured), int(asked)) == (len(found), len(cells))


def test_committed_runs_cover_the_documented_grid_except_the_new_method(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (text,) = (block for block in blocks if "past_to_frame" in block)
    (tmp_path / "grid.toml").write_text(text.replace(', "past_to_frame"', ""))
    cells = load_grid(str(tmp_path / "grid.toml")).cells()
    kept = [run for name in ("control", "offline") for run in read_results(EARLIER / name)]
    assert len(GridMembers("grid", cells).among(kept)) == len(cells) == 12


def test_missing_runs_are_those_of_the_grid(grid, runs, tmp_path):
    write_results(
        tmp_path / "rows", [run for run in runs if (run.labels["method"], run.labels["seed"]) != ("mik+a", 1)]
    )
    words = ["report", str(tmp_path / "rows"), "--out", str(tmp_path / "report"), "--grid", str(grid)]
    main(words)
    (row,) = csv.DictReader((tmp_path / "report" / "missing.csv").open())
    assert (row["method"], row["seed"], row["state"]) == ("mik+a", "1", "missing")
    one_seed = '[[block]]\npretrain = { method = "acro" }\n[[block]]\nseed = 0\npretrain = { method = "mik+a" }\n'
    grid.write_text(GRID + one_seed)
    main(words)
    assert not (tmp_path / "report" / "missing.csv").exists()


def test_cells_without_runs_are_missing_in_reported_settings(grid, runs, tmp_path):
    (one,) = (run for run in runs if (run.labels["method"], run.labels["seed"]) == ("acro", 0))
    write_results(tmp_path / "rows", [one])
    grid.write_text(GRID.replace('"expert"', '["expert", "medium"]'))
    words = ["report", str(tmp_path / "rows"), "--out", str(tmp_path / "report")]
    main([*words, "--grid", str(grid)])
    rows = list(csv.DictReader((tmp_path / "report" / "missing.csv").open()))
    assert {(row["quality"], row["method"], row["seed"], row["state"]) for row in rows} == {
        ("expert", method, seed, "missing") for method, seed in (("acro", "1"), ("mik+a", "0"), ("mik+a", "1"))
    }
    with (tmp_path / "report" / "summary.csv").open() as file:
        assert {row["method"]: row["missing"] for row in csv.DictReader(file)} == {
            "acro": "seed 1 missing", "mik+a": "seeds 0, 1 missing",
        }  # fmt: skip


def test_missing_variants_follow_the_grid(grid, runs, tmp_path):
    write_results(tmp_path / "rows", [run for run in runs if run.labels["method"] == "acro"])
    block = '[[block]]\nseed = {}\npretrain = {{ method = "acro", history = "{}", corruption = "{}" }}\n'
    blocks = [("[0, 1, 2]", "method", "patch"), ("[1, 2]", "gru", "patch"), ("[0]", "gru", "none")]
    grid.write_text(GRID.replace("seed = [0, 1]\n", "") + "".join(block.format(*one) for one in blocks))
    main(["report", str(tmp_path / "rows"), "--out", str(tmp_path / "report"), "--grid", str(grid)])
    with (tmp_path / "report" / "missing.csv").open() as file:
        missed = {(row["corruption"], row["variant"], row["seed"]) for row in csv.DictReader(file)}
    assert missed == {("patch", "", "2"), ("patch", "history gru", "1"), ("patch", "history gru", "2")}


def test_noise_option_appears_in_the_quality_of_missing_runs(grid, runs, tmp_path):
    grid.write_text(GRID.replace('quality = "expert"', 'quality = "random"\naction_noise = 0.4'))
    asked = GridMembers("grid", load_grid(str(grid)).cells())
    assert {row["quality"] for row in asked.wanted} == {"random_noise0.4"}


def test_report_is_restricted_to_selected_cells(grid, runs, tmp_path, capsys):
    write_results(tmp_path / "rows", runs)
    words = ["report", str(tmp_path / "rows"), "--out", str(tmp_path / "report")]
    main([*words, "--grid", str(grid), "--only", "method=acro"])
    assert [run.labels["method"] for run in read_results(tmp_path / "report")] == ["acro", "acro"]
    capsys.readouterr()
    for flags, message in (
        (["--only", "method=acro"], "--only and --change apply to the cells of a grid: add --grid"),
        (["--grid", "navigation"], "navigation: its cells are mazes; `vd4rl-pomdp navigation report` reports them"),
    ):
        assert message in rejection([*words, *flags])
