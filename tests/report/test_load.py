"""Damaged runs are named, and nothing is written."""

import numpy as np
import pytest

from tests.helpers_report import describe, write_run
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report import write_report
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes


def test_bad_input_is_one_line(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="contains no runs"):
        write_report([tmp_path / "empty"], tmp_path / "out")
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    write_run(tmp_path / "b", "acro", 0, {10: [2.0]})
    with pytest.raises(UserError, match="two runs of one method"):
        write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    (tmp_path / "a" / "metrics.jsonl").write_text("{\n")
    with pytest.raises(UserError, match="a line is not JSON of numbers"):
        write_report([tmp_path / "a"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_cut_rows_and_films_are_named(tmp_path):
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    rows = tmp_path / "a" / "episodes.csv"
    whole = rows.read_text()
    rows.write_text(whole + "acro,walker_w")
    with pytest.raises(UserError, match=r"episodes\.csv: a row is not whole"):
        write_report([tmp_path / "a"], tmp_path / "out")
    rows.write_text(whole)
    film = tmp_path / "a" / "film.npz"
    np.savez_compressed(film, clean=np.arange(999))
    packed = film.read_bytes()
    for damaged in (b"cut", packed[:100] + b"\xff" * 99 + packed[199:]):
        film.write_bytes(damaged)
        with pytest.raises(UserError, match=r"film\.npz: cannot be read"):
            write_report([tmp_path / "a"], tmp_path / "out")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("column", ["score", "return"])
def test_a_score_that_is_no_number_is_refused(tmp_path, value, column):
    run = write_run(tmp_path / "runs/a", "acro", 3, {10: [1.0, 2.0]})
    rows = read_episodes(run / "episodes.csv")
    (run / "episodes.csv").unlink()
    append_episodes(run / "episodes.csv", [rows[0], rows[1] | {column: value}])
    with pytest.raises(UserError, match=rf"episodes\.csv: .*{value}"):
        write_report([tmp_path / "runs"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_labels_and_cards_that_are_not_whole_are_named(tmp_path):
    run = describe(write_run(tmp_path / "runs/a", "acro", 0, {10: [2.0]}), {})
    (tmp_path / "runs" / "b").mkdir()
    for name in ("config.json", "metrics.jsonl"):
        (tmp_path / "runs" / "b" / name).write_bytes((run / name).read_bytes())
    (tmp_path / "runs" / "b" / "labels.json").write_text("{}")
    with pytest.raises(UserError, match=r"b/labels\.json: has no 'method'"):
        write_report([tmp_path / "runs"], tmp_path / "out")
    (run / "encoder" / "config.json").write_text("{}")
    with pytest.raises(UserError, match="does not say how the encoder was pretrained"):
        write_report([run], tmp_path / "out")
    (run / "encoder" / "config.json").write_text('{"pretrain": {"corruption": ["patch"]}}')
    with pytest.raises(UserError, match=r"a: its files are damaged"):
        write_report([run], tmp_path / "out")
