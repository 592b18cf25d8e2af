"""A stranger's rows: what their own records contradict is said, and an episode is replayed to the digit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from finetune.train import finetune
from tests.helpers_stages import smoke_finetune
from tests.runs.results.test_results import COMMITTED, whole_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import add_results, read_results, verify_results


def changed(results: Path, change: Callable[[dict[str, Any]], Any]) -> list[str]:
    """What is said of a results folder whose first run's line was changed."""
    first, *others = (results / "runs.jsonl").read_text().splitlines()
    told = json.loads(first)
    change(told)
    (results / "runs.jsonl").write_text("\n".join([json.dumps(told), *others]) + "\n")
    return verify_results(results)[1]


@pytest.fixture
def results(tmp_path) -> Path:
    for seed in (0, 1):
        whole_run(tmp_path / f"runs/{seed}", seed)
    add_results([tmp_path / "runs"], tmp_path / "results")
    return tmp_path / "results"


@pytest.mark.parametrize(
    "folder", sorted({path.parent for path in COMMITTED.rglob("runs.jsonl")}), ids=lambda p: p.name
)
def test_the_committed_rows_contradict_nothing(folder):
    assert verify_results(folder)[1] == []


def test_an_id_is_computed_anew_from_every_part_of_the_record_that_decides_a_number(results):
    first, second = read_results(results)
    assert verify_results(results)[1] == []
    (told,) = changed(results, lambda told: told["config"]["inputs"].update(data="f01"))
    assert told.startswith(f"run {first.id}: its record computes ")
    assert len(changed(results, lambda told: told["config"]["inputs"].update(data="f00"))) == 0
    assert len(changed(results, lambda told: told["config"]["config"].update(updates=11))) == 1
    assert second.id not in told


def test_episodes_are_of_the_run_that_they_name_each_once_and_scored_by_their_returns(results, capsys):
    path, (first, _) = results / "episodes.csv", read_results(results)
    head, *rows = path.read_text().splitlines()
    mine = rows[0].split(",")
    assert (mine[0], mine[7]) == (first.id, "5"), "its step"
    mine[6], mine[7], mine[12] = "7", "10", "99.0"  # seed, the other row's step, score
    path.write_text("\n".join([head, ",".join(mine), *rows[1:]]) + "\n")
    with pytest.raises(SystemExit) as ended:
        main(["results", "verify", str(results)])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"run {first.id}: 1 episodes have the seed 7, its record 0",
        f"run {first.id}: 1 episodes stand there twice",
        f"run {first.id}: 1 scores are not their returns / 10",
        "2 runs, 3 contradictions between rows and records",
    ]
    assert err == f"error: {results}: 3 contradictions, see above; ask who made the rows\n"


def test_an_episode_is_replayed_to_the_digit_and_a_difference_names_what_drew_and_computed(
    data, encoder, tmp_path, capsys
):
    run = finetune(smoke_finetune(encoder, data, tmp_path / "run", eval_length=4)).path
    write_json(run / "render.json", read_json(run / "render.json") | {"gl_renderer": "another renderer"})
    whole_run(tmp_path / "other")
    results = tmp_path / "results"
    add_results([run, tmp_path / "other"], results)
    words = ["results", "verify", str(results), "--replay"]
    main([*words, str(run)])
    rows = [row for one in read_results(results) for row in one.rows if row["length"] == 4]
    row = next(r for r in rows if r["step"] == rows[-1]["step"] and r["evaluated_under"] == r["corruption"])
    assert f"replays to a return of {row['return']}" in capsys.readouterr().out
    path = results / "episodes.csv"
    path.write_text(path.read_text().replace(f",{row['return']},4,", f",{row['return'] + 1},4,"))
    with pytest.raises(SystemExit):
        main([*words, str(run)])
    err = capsys.readouterr().err
    assert f"replays to return {row['return']} where it says {row['return'] + 1}; the row was made with mujoco" in err
    assert "another renderer" in err.partition(", this is ")[0]
    add_results([tmp_path / "other"], tmp_path / "without")
    with pytest.raises(SystemExit):
        main(["results", "verify", str(tmp_path / "without"), "--replay", str(run)])
    assert "has no row there; name the folder of one that has" in capsys.readouterr().err


@pytest.mark.parametrize("critic", [{"value": "much"}, {"moved": True}, {"moved": float("nan")}, {"valu": 1.0}, [1.0]])
def test_a_damaged_critic_is_refused_at_the_door(tmp_path, critic):
    run = whole_run(tmp_path / "run")
    write_json(run / "critic.json", critic)
    with pytest.raises(UserError, match=r"critic|JSON object"):
        add_results([run], tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_an_empty_critic_is_refused_beside_a_critics_metrics_and_counts_for_nothing_beside_a_discount(tmp_path):
    run = whole_run(tmp_path / "run")
    write_json(run / "critic.json", {})
    assert load_runs([run])[0].converged is True, "an algorithm without one"
    record = read_json(run / "config.json")
    write_json(run / "config.json", record | {"config": record["config"] | {"gamma": 0.99}})
    assert load_runs([run])[0].converged is None
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 10, "q": 150.0}) + "\n")
    with pytest.raises(UserError, match=r"critic\.json: tells of no critic, metrics\.jsonl of one; put it back"):
        add_results([run], tmp_path / "results")
