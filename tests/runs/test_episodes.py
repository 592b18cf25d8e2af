"""The table of evaluation episodes: damage is named, and existing rows stay."""

import os
import threading

import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.episodes import COLUMNS, append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import appending

ROWS = (
    ",".join(COLUMNS)
    + """
acro,walker_walk,expert,patch,td3_bc,0,1,0,20000,719.1985,500,71.9199,patch,
acro,walker_walk,expert,patch,td3_bc,0,2,0,20000,847.1,500,84.71,none,0.25
"""
)


def test_episode_rows_round_trip_with_extra_columns(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text(ROWS)
    rows = read_episodes(path)
    assert [(row["evaluated_under"], row["action_error"]) for row in rows] == [("patch", None), ("none", 0.25)]
    assert (rows[0]["seed"], rows[0]["return"]) == (0, 719.1985)
    append_episodes(path, rows)
    assert path.read_text() == ROWS + "".join(ROWS.splitlines(keepends=True)[1:])
    header, *lines = ROWS.splitlines()
    path.write_text("\n".join([f"{header},variant", *(f"{line},max_k 1" for line in lines)]) + "\n")
    append_episodes(path, [rows[0] | {"step": 3}])
    drop_episodes_after(path, 2)
    assert read_episodes(path) == [row | {"variant": "max_k 1"} for row in rows]


def test_header_is_written_once(tmp_path):
    path = tmp_path / "episodes.csv"
    append_episodes(path, [])
    header = path.read_text()
    assert header == ",".join(COLUMNS) + "\n"
    append_episodes(path, [])
    assert path.read_text() == header
    with pytest.raises(UserError, match=r"nowhere/episodes\.csv: cannot be used"):
        append_episodes(tmp_path / "nowhere" / "episodes.csv", [])


def test_concurrent_append_waits_for_the_lock(tmp_path):
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


ENDS = ("", ",", ",patch", ",patch,nan", ",patch,0.1.2", ",,0.1", ",patch,0.1,more")
CELLS = ("nan", "inf", "many", "9" * 200_000)


@pytest.mark.parametrize(
    ("old", "new"),
    [*((",patch,\n", f"{end}\n") for end in ENDS), *(("71.9199", cell) for cell in CELLS)],
    ids=range(11),
)
def test_damaged_episode_table_is_rejected_and_kept(tmp_path, old, new):
    path = tmp_path / "episodes.csv"
    path.write_text(before := ROWS.replace(old, new))
    assert before != ROWS
    for read in (lambda: read_episodes(path), lambda: drop_episodes_after(path, 1)):
        with pytest.raises(UserError, match=r"episodes\.csv: (a row is not whole|the score of seed 0)"):
            read()
    assert path.read_text() == before


def test_truncated_last_row_is_rejected_until_dropped(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text(ROWS)
    row = read_episodes(path)[0]
    path.write_text(ROWS[:-2])
    for use in (read_episodes, lambda path: append_episodes(path, [row])):
        with pytest.raises(UserError, match=r"a row is not whole \(the last line has no end\); remove that row"):
            use(path)
    assert path.read_text() == ROWS[:-2]
    drop_episodes_after(path, 2)
    assert read_episodes(path) == [row]


def test_appended_lines_are_fsynced(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "rows", []
    monkeypatch.setattr("os.fsync", lambda handle: synchronised.append((os.fstat(handle).st_ino, path.read_text())))
    with appending(path) as file:
        file.write("one\n")
    assert synchronised == [(path.stat().st_ino, "one\n")]
