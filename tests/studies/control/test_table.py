import pytest

from vd4rl_pomdp.studies.control.config import MEASURED, ControlRun
from vd4rl_pomdp.studies.control.table import difference, line_of, summary


def rows(method: str, *returns: float, share: float = 0.5, read=("state", 0.0, 0)) -> list[dict]:
    """Rows of runs.csv, a seed each."""
    made = []
    for seed, value in enumerate(returns):
        run = ControlRun("walker_walk", 0.5, share, 50, 500, 3000, 10_000, 20, method, *read, seed)
        numbers = dict.fromkeys(MEASURED, 0.1) | {"data_return": 700.0, "return": value}
        made.append(run.labels | numbers | {"return_min": value - 10, "return_max": value + 10, "git_commit": ""})
    return made


def told(*groups: list[dict]) -> list[str]:
    return list(summary([row for group in groups for row in group]))


CEILING = rows("none", 690.0, 650.0, share=0.0)


def test_differences_are_taken_seed_by_seed():
    both = [*rows("mik", 300.0, 200.0, 100.0), *rows("none", 290.0, 180.0)]
    found = difference(both, "mik", "none")
    assert (found.mean, found.error, found.n) == (15.0, pytest.approx(5.0), 2)
    assert difference(both, "mik", "ah") is None
    assert not difference(rows("mik", 300.0) + rows("none", 1.0), "mik", "none").tells, "one seed tells nothing"


def test_methods_are_ranked_and_answers_given_where_all_gates_are_reached():
    lines = told(rows("none", 110.0, 90.0), rows("mik", 260.0, 270.0), rows("mik+a", 480.0, 460.0), CEILING)
    assert "gate, nothing hidden and no memory: 0.96 of the data's return (n = 2), at least 0.9, reached" in lines
    assert "gate, mik+a minus none: +370 ± 0 (n = 2), at least 2 standard errors, reached" in lines
    assert "memory pays: mik minus none is +165 ± 15 (n = 2)" in lines
    assert "past actions pay: mik+a minus mik is +205 ± 15 (n = 2)" in lines
    assert [line.split()[0] for line in lines if " to " in line][-3:] == ["mik+a", "mik", "none"]
    assert not any("undecided at this budget" in line for line in lines)


def test_a_policy_that_reads_no_memory_answers_nothing_about_it():
    frame = ("frame", 0.0, 0)
    lines = told(rows("none", 110.0, 90.0), rows("mik", 260.0, 270.0), rows("mik", 80.0, 70.0, read=frame), CEILING)
    assert [line for line in lines if "memory pays" in line] == ["memory pays: mik minus none is +165 ± 15 (n = 2)"]


def test_what_the_seeds_do_not_tell_is_said():
    lines = told(rows("none", 10.0, 9.0), rows("mik", 260.0, 270.0), rows("mik+a", 480.0, 200.0), rows("ah", 8.0, 7.0))
    assert "the seeds do not tell whether past actions pay: mik+a minus mik is +75 ± 145 (n = 2)" in lines
    assert "memory does not pay: ah minus none is -2 ± 0 (n = 2)" in lines


@pytest.mark.parametrize(
    "groups",
    [
        [rows("none", 110.0, 90.0), rows("mik", 100.0, 180.0)],
        [rows("none", 110.0, 90.0), rows("mik", 300.0, 300.0), rows("random", 280.0, 310.0)],
        [rows("random", 310.0, 300.0), rows("mik", 200.0, 201.0)],
        [rows("none", 110.0, 90.0), rows("mik", 600.0, 600.0), rows("none", 100.0, 200.0, share=0.0)],
    ],
    ids=["noise", "no better than an untrained memory", "the floor is best", "nobody walks"],
)
def test_a_setting_that_misses_a_gate_is_not_ranked(groups):
    lines = told(*groups)
    said = max(i for i, line in enumerate(lines) if line == "undecided at this budget: methods are listed by name")
    methods = {row["method"] for group in groups for row in group if row["hidden_share"] == "0.5"}
    assert [line.split()[0] for line in lines[said + 2 :] if line][: len(methods)] == sorted(methods)
    assert any(line.startswith("gate, ") and line.endswith("missed") for line in lines)
    assert not any("pay" in line for line in lines)


def test_what_is_read_of_a_memory_is_part_of_a_methods_name():
    last = ("state", 0.0, 4)
    groups = [rows("none", 110.0, 90.0), rows("mik", 260.0, 270.0), rows("mik", 400.0, 390.0, read=last)]
    lines = told(*groups, rows("mik+a", 500.0, 480.0, read=last), rows("mik+a", 1.0, 2.0, read=("frame+state", 0.5, 0)))
    assert "memory pays: mik, last 4 rows minus none is +295 ± 5 (n = 2)" in lines
    assert "past actions pay: mik+a, last 4 rows minus mik, last 4 rows is +95 ± 5 (n = 2)" in lines
    assert any(line.startswith("mik+a, readout frame+state, 0.5 random histories  2 ") for line in lines)
    assert sum("minus" in line for line in lines) == 4, "nothing to compare the last one with"


def test_a_ceiling_that_was_not_measured_is_said():
    lines = told(rows("none", 110.0, 90.0), rows("mik", 300.0, 310.0))
    assert "gate, nothing hidden and no memory: -, not measured" in lines
    assert lines[-1] == "memory pays: mik minus none is +205 ± 15 (n = 2)"


def test_a_single_seed_measures_no_gate():
    lines = told(rows("none", 110.0), rows("mik", 600.0))
    assert "gate, mik minus none: +490 (n = 1), one seed has no standard error, not measured" in lines
    assert lines[-1] == "the seeds do not tell whether memory pays: mik minus none is +490 (n = 1)"


def test_the_best_method_is_one_of_two_seeds_where_there_are_any():
    lines = told(rows("none", 110.0, 90.0), rows("mik", 260.0, 270.0), rows("ah", 500.0))
    assert "gate, mik minus none: +165 ± 15 (n = 2), at least 2 standard errors, reached" in lines
    lines = told(rows("none", 310.0, 290.0), rows("mik", 500.0))
    assert "gate, mik minus none: +190 (n = 1), one seed has no standard error, not measured" in lines


def test_a_run_is_told_on_one_line():
    (row,) = rows("mik", 300.0)
    told_of = "walker_walk, noise 0.5, hidden 0.5; mik, seed 0; returns 300 (290 to 310) of the data's 700; "
    assert line_of(row).startswith(f"{told_of}action error 0.100 on the data, 0.100 in closed loop; probes 0.1, 0.1;")
