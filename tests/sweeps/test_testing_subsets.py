"""Cells of the shipped grids' testing subsets, from collection to evaluation."""

import pytest

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.runs.results import read_run


@pytest.mark.parametrize(
    ("grid", "only", "jobs", "last"),
    [
        ("quick", ["method=acro"], 3, "walker_walk/expert_noisy/patch+zero_frames/acro/seed0/finetune-td3_bc"),
        ("quick_navigation", ["method=no_history"], 2, "three_curtains/no_history/seed0"),
    ],
)
def test_testing_cell_runs_end_to_end(tmp_path, capsys, grid, only, jobs, last):
    words = ["sweep", "run", grid, "--testing", "--only", *only, "--out", str(tmp_path / "out")]
    main([*words, "--jobs", "2"])  # one thread per job: two threads stall when tests run in parallel
    assert f"all {jobs} jobs are finished" in capsys.readouterr().out
    assert read_json(tmp_path / "out" / last / "timing.json")["seconds"] > 0
    if grid == "quick":
        assert {row["evaluated_under"] for row in read_run(tmp_path / "out" / last).rows} == {"patch+zero_frames"}
    else:
        main(["navigation", "report", str(tmp_path / "out"), "--out", str(tmp_path / "report"), "--no-pictures"])
        assert (tmp_path / "report" / "tables.csv").is_file()
        main([*words[:-1], str(tmp_path / "elsewhere"), "--done", str(tmp_path / "report"), "--dry-run"])
        assert f"{last}: done" in capsys.readouterr().out, "a sweep continues from the report's rows"
    main(["sweep", "status", str(tmp_path / "out")])
    assert f"{jobs} jobs: {jobs} done" in capsys.readouterr().out
