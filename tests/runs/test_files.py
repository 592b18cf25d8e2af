import os

import pytest

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.files import appending, read_csv, write_csv

COLUMNS = ("name", "value")


def test_a_table_is_read_as_it_was_written(tmp_path):
    rows = [{"name": "a, b", "value": "1.5"}, {"name": "nan", "value": "-2"}]
    write_csv(tmp_path / "table.csv", COLUMNS, rows)
    assert read_csv(tmp_path / "table.csv", COLUMNS, ("name",)) == rows
    assert read_csv(tmp_path / "none.csv", COLUMNS, ("name",)) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("value,name\n1,a\n", "has other columns than name, value"),
        ("name,value\na,inf\n", "a number is not finite"),
        ("name,value\na,many\n", "could not convert"),
        ("name,value\na\n", "is damaged"),
    ],
)
def test_another_table_or_a_damaged_one_is_a_sentence(text, message, tmp_path):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(UserError, match=message):
        read_csv(tmp_path / "table.csv", COLUMNS, ("name",))


def test_appended_lines_are_on_the_disk_when_the_block_ends(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "rows", []
    monkeypatch.setattr("os.fsync", lambda handle: synchronised.append((os.fstat(handle).st_ino, path.read_text())))
    with appending(path) as file:
        file.write("one\n")
    assert synchronised == [(path.stat().st_ino, "one\n")]
