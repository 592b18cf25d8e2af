"""A stranger's rows: what their own records contradict is said, and an episode is replayed to the digit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from finetune.train import finetune
from tests.helpers_stages import CutError, cut_at, smoke_finetune
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


def edited(results: Path, row: int, **cells: str) -> None:
    """Write into a row of episodes.csv."""
    path = results / "episodes.csv"
    head, *rows = [line.split(",") for line in path.read_text().splitlines()]
    for name, value in cells.items():
        rows[row][head.index(name)] = value
    path.write_text("".join(",".join(line) + "\n" for line in [head, *rows]))


def test_episodes_are_of_the_run_that_they_name_each_once_and_scored_by_their_returns(results, capsys):
    first, _ = read_results(results)
    edited(results, 0, seed="7", step="10", score="99.0")  # the other row's step
    with pytest.raises(SystemExit) as ended:
        main(["results", "verify", str(results)])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"run {first.id}: an episode has the seed 7, its record 0 (1 such)",
        f"run {first.id}: at step 10 under patch it has the episodes [0, 0], its record 2, from 0 on",
        f"run {first.id}: 1 scores are not their returns / 10",
        "2 runs, 3 contradictions between rows and records",
    ]
    assert err == f"error: {results}: 3 contradictions, see above; ask their author\n"


OWN = "patch+zero_frames"
EDITED_ROWS = [
    (0, {"episode": "5"}, f"at step 20 under {OWN} it has the episodes [5, 1], its record 2, from 0 on"),
    (1, {"step": "30"}, f"at step 20 under {OWN} it has the episodes [0], its record 2, from 0 on"),
    (2, {"step": "60"}, f"at step 60 under {OWN} it has the episodes [0], its record 0, from 0 on"),
    (3, {"evaluated_under": "none"}, f"at step 40 under {OWN} it has the episodes [0], its record 2, from 0 on"),
    (4, {"evaluated_under": "glitch"}, "at step 40 under none it has the episodes [], its record 1, from 0 on"),
    (0, {"episode_seed": "20007"}, "1 environment seeds are not those of their numbers"),
    (0, {"length": "5"}, "1 lengths are not within 1 and 4"),
    (0, {"quality": "medium"}, "an episode has the quality medium, its record expert (1 such)"),
    (0, {"corruption": "none"}, "an episode has the corruption none, its record patch+zero_frames (1 such)"),
    (0, {"action_error": "0.1"}, "1 action errors are missing, or present without an actor"),
    (0, {"score": "0.9"}, "1 scores are not their returns / 10"),
]
EDITED_RECORDS = [
    (("labels", "quality"), "medium", "its labels have the quality medium, its record expert (1 such)"),
    (("step",), 39, "it ends with update 39, its record with 40"),
    (("timing", "updates"), 50, "it ends with update 50, its record with 40"),
    (
        ("config", "config", "eval_episodes"),
        3,
        f"at step 20 under {OWN} it has the episodes [0, 1], its record 3, from 0 on",
    ),
    (("encoder", "pretrain", "corruption", "patch_size"), 24, "its encoder says patch_size 24, its settings 16"),
    (("critic", "data"), 1.0, "its critic.json has data value 1.0, but mean reward"),
    (("reference", "mean_reward"), 1.0, "but mean reward 1.0 gives 100.0000"),
]


def test_what_was_edited_by_hand_is_found(data, encoder, tmp_path):
    # two episodes after 20 updates and after 40, then one under no corruption
    settings = {"eval_length": 4, "eval_episodes": 2, "eval_clean_episodes": 1}
    results = tmp_path / "results"
    add_results([finetune(smoke_finetune(encoder, data, tmp_path / "run", **settings)).path], results)
    assert verify_results(results)[1] == []
    whole = {path: path.read_text() for path in results.glob("*.*")}
    for row, cells, said in EDITED_ROWS:
        edited(results, row, **cells)
        told = verify_results(results)[1]
        assert [one for one in told if one.endswith(f": {said}")], (cells, told)
        (results / "episodes.csv").write_text(whole[results / "episodes.csv"])
    for place, value, said in EDITED_RECORDS:

        def edit(told: dict[str, Any], place: tuple[str, ...] = place, value: Any = value) -> None:
            for name in place[:-1]:
                told = told[name]
            assert told[place[-1]] != value
            told[place[-1]] = value

        told = changed(results, edit)
        assert [one for one in told if said in one], (place, told)
        (results / "runs.jsonl").write_text(whole[results / "runs.jsonl"])
    head, first, second, *others = whole[results / "episodes.csv"].splitlines(keepends=True)
    (results / "episodes.csv").write_text("".join([head, second, first, *others]))
    (told,) = verify_results(results)[1]  # intervals pair episodes by their place
    assert told.endswith(f"at step 20 under {OWN} it has the episodes [1, 0], its record 2, from 0 on")
    (results / "episodes.csv").write_text(head)
    told = changed(results, lambda told: told.update(episodes=0))
    assert len(told) == 3, "two evaluations and an uncorrupted one"


def test_what_may_change_is_recorded_as_it_was_when_the_run_ended(data, encoder, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        cut_at(patch, 2)
        with pytest.raises(CutError):
            finetune(smoke_finetune(encoder, data, tmp_path / "run", eval_length=4))
    run = finetune(smoke_finetune(encoder, data, tmp_path / "run", eval_length=4, eval_clean=False, log_every=5)).path
    add_results([run], tmp_path / "results")
    (told,) = read_results(tmp_path / "results")
    assert (told.record["config"]["eval_clean"], told.record["config"]["log_every"]) == (False, 5)
    assert verify_results(tmp_path / "results")[1] == []


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
    assert "has no rows in the results folder; name a run that has" in capsys.readouterr().err


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
    with pytest.raises(UserError, match=r"critic\.json: has no critic, metrics\.jsonl has one; put it back"):
        add_results([run], tmp_path / "results")
