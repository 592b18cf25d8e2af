"""A report on the terminal."""

import io

from rich.console import Console

from tests.helpers_report import write_seeds
from vd4rl_pomdp.report import write_report
from vd4rl_pomdp.report.terminal import print_summary


def test_no_label_is_broken_within_a_word_at_eighty_columns(tmp_path):
    runs = tmp_path / "runs"
    write_seeds(runs, {("mik+a", "patch"): (50.0, 60.0, 55.0), ("acro", "patch"): (10.0, 12.0, 11.0)}, 600)
    write_seeds(runs, {("mik+a", "none"): (70.0, 71.0, 72.0)}, 600, random_histories=0.5)
    shown = io.StringIO()
    print_summary(write_report([runs], tmp_path / "out"), Console(file=shown, width=80))
    assert "seeds 0, 1, 2" in shown.getvalue(), "a column that takes room"
    assert shown.getvalue().count("random_histories") == 2, "a line in each table"
    borders = [line[-1] for line in shown.getvalue().splitlines() if line[:1] in tuple("┏┃┡│└")]
    assert set(borders) == set("┓┃┩│┘"), "a table that is wider than the terminal loses its right border"
