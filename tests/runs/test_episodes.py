"""The table of evaluation episodes: what is damaged is named, what is there stays."""

import threading

import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.episodes import COLUMNS, append_episodes, begin_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import appending

EARLIER = """method,task,quality,corruption,algorithm,seed,step,episode,episode_seed,return,length,score
acro,walker_walk,expert,patch,td3_bc,0,1,0,20000,719.1985,500,71.9199
acro,walker_walk,expert,patch,td3_bc,0,2,0,20000,847.1,500,84.71
"""


def test_a_table_of_an_earlier_version_is_read_and_appended_to(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text(EARLIER)
    rows = read_episodes(path)
    assert [(row["evaluated_under"], row["action_error"]) for row in rows] == [("patch", None)] * 2
    assert path.read_text() == EARLIER, "reading changes nothing"
    new = rows[1] | {"step": 3, "evaluated_under": "none", "action_error": 0.25}
    append_episodes(path, [new])
    lines = EARLIER.splitlines()
    assert path.read_text().splitlines() == [
        f"{lines[0]},evaluated_under,action_error",
        *(f"{line},patch," for line in lines[1:]),
        lines[2].replace("0,2,0", "0,3,0") + ",none,0.25",
    ]
    assert read_episodes(path) == [*rows, new]
    drop_episodes_after(path, 2)
    assert read_episodes(path) == rows


def test_columns_of_ones_own_stay_in_a_table_that_is_appended_to(tmp_path):
    path = tmp_path / "episodes.csv"
    lines = EARLIER.splitlines()
    path.write_text("\n".join([f"{lines[0]},variant", f"{lines[1]},max_k 1"]) + "\n")
    row = {name: value for name, value in read_episodes(path)[0].items() if name != "variant"}
    append_episodes(path, [row])
    assert read_episodes(path) == [row | {"variant": "max_k 1"}, row | {"variant": ""}]
    append_episodes(path, [row | {"step": 7}])
    drop_episodes_after(path, 6)
    assert read_episodes(path) == [row | {"variant": "max_k 1"}, row | {"variant": ""}]


@pytest.mark.parametrize("end", ["", ",", ",patch", ",patch,nan", ",patch,0.1.2", ",,0.1", ",patch,0.1,more"])
def test_a_row_whose_end_is_missing_or_wrong_is_not_read(tmp_path, end):
    path = tmp_path / "episodes.csv"
    lines = EARLIER.splitlines()
    path.write_text(f"{lines[0]},evaluated_under,action_error\n{lines[1]}{end}\n")
    with pytest.raises(UserError, match="a row is not whole"):
        read_episodes(path)


def test_a_table_of_episodes_is_begun_before_any_is_played_and_only_once(tmp_path):
    path = tmp_path / "episodes.csv"
    begin_episodes(path)
    header = path.read_text()
    assert header == ",".join(COLUMNS) + "\n"
    begin_episodes(path)
    assert path.read_text() == header
    with pytest.raises(UserError, match=r"nowhere/episodes\.csv: cannot be used"):
        begin_episodes(tmp_path / "nowhere" / "episodes.csv")


def test_who_finds_another_appending_waits_and_writes_no_second_header(tmp_path):
    path, begun = tmp_path / "episodes.csv", threading.Event()

    def append() -> None:
        begun.set()
        append_episodes(path, [])

    with appending(path) as file:
        other = threading.Thread(target=append)
        other.start()
        begun.wait()
        other.join(0.3)
        assert other.is_alive()
        file.write(",".join(COLUMNS) + "\n")
    other.join()
    assert path.read_text() == ",".join(COLUMNS) + "\n"


def test_a_line_that_was_cut_is_dropped_with_what_follows_the_checkpoint(tmp_path):
    path = tmp_path / "episodes.csv"
    row = dict.fromkeys(("method", "task", "quality", "corruption", "algorithm"), "x")
    row |= dict.fromkeys(("seed", "episode", "episode_seed", "return", "length", "score", "evaluated_under"), 1)
    append_episodes(path, [row | {"step": 1}, row | {"step": 2}])
    path.write_text(path.read_text() + "mik+a,walker_w")
    with pytest.raises(UserError, match="a row is not whole"):
        read_episodes(path)
    drop_episodes_after(path, 1)
    assert [row["step"] for row in read_episodes(path)] == [1]


@pytest.mark.parametrize("cell", ["nan", "inf", "many", "9" * 200_000], ids=["nan", "inf", "word", "endless"])
def test_a_damaged_table_of_episodes_is_named_and_kept(tmp_path, cell):
    path = tmp_path / "episodes.csv"
    row = dict.fromkeys(("method", "task", "quality", "corruption", "algorithm"), "x")
    row |= dict.fromkeys(("seed", "episode", "episode_seed", "return", "length", "evaluated_under"), 1)
    append_episodes(path, [row | {"step": 1, "score": cell}])
    before = path.read_bytes()
    for read in (lambda: read_episodes(path), lambda: drop_episodes_after(path, 1)):
        with pytest.raises(UserError, match=r"episodes\.csv: (a row is not whole|the score of seed 1)"):
            read()
    assert path.read_bytes() == before


def test_a_row_that_a_full_disk_cut_is_not_read_and_nothing_is_glued_to_it(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text(EARLIER)
    row = read_episodes(path)[0]
    path.write_text(EARLIER[:-2])
    for use in (read_episodes, lambda path: append_episodes(path, [row])):
        with pytest.raises(UserError, match=r"a row is not whole \(the last line has no end\); remove it"):
            use(path)
    assert path.read_text() == EARLIER[:-2]
