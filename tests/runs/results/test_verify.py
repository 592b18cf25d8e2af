"""`results verify`: contradictions between rows and records are reported, and episodes replay exactly."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from finetune.train import finetune
from tests.helpers_bad_input import rejection
from tests.helpers_stages import run_until_cut, smoke_finetune
from tests.runs.results.test_results import whole_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import add_results, read_results, verify_results, write_results
from vd4rl_pomdp.runs.run import identity

COMMITTED = Path(__file__).parents[3] / "results"


def changed(results: Path, change: Callable[[dict[str, Any]], Any]) -> list[str]:
    """Change the first run's line of a results folder and return the contradictions found."""
    first, *others = (results / "runs.jsonl").read_text().splitlines()
    line = json.loads(first)
    change(line)
    (results / "runs.jsonl").write_text("\n".join([json.dumps(line), *others]) + "\n")
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
def test_committed_results_verify_and_are_complete(folder):
    assert verify_results(folder)[1] == []
    for run in read_results(folder):
        assert run.ending
        learns_no_actions = run.record["config"].get("method") in ("random", "state", "supervised+a")
        assert run.measured or run.losses or learns_no_actions
        assert run.labels["task"]
        assert run.record["command"]
        assert run.record["git_commit"]
        assert run.files["machine"]["processor"]


def test_verify_recomputes_run_id_from_record(results):
    first, second = read_results(results)
    assert verify_results(results)[1] == []
    (found,) = changed(results, lambda line: line["config"]["inputs"].update(data="f01"))
    assert found.startswith(f"run {first.id}: its record computes ")
    assert len(changed(results, lambda line: line["config"]["inputs"].update(data="f00"))) == 0
    assert len(changed(results, lambda line: line["config"]["config"].update(updates=11))) == 1
    assert second.id not in found


def edited(results: Path, row: int, **cells: str) -> None:
    """Overwrite cells of a row of episodes.csv."""
    path = results / "episodes.csv"
    head, *rows = [line.split(",") for line in path.read_text().splitlines()]
    for name, value in cells.items():
        rows[row][head.index(name)] = value
    path.write_text("".join(",".join(line) + "\n" for line in [head, *rows]))


def test_verify_command_reports_contradictory_episodes(results, capsys):
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
    (0, {"length": "5"}, "1 lengths are not 4"),
    (0, {"length": "3"}, "1 lengths are not 4"),
    (0, {"return": "8.5", "score": "0.85"}, "1 returns are not within 0 and 2 per decision"),
    (0, {"return": "-5.0", "score": "-0.5"}, "1 returns are not within 0 and 2 per decision"),
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
    (("episodes",), 3, "2 rows more than runs.jsonl says"),
]
COLLECTED = {"task": "walker_walk", "quality": "expert", "action_noise": None}


def test_verify_finds_manual_edits(data, encoder, tmp_path):
    # two episodes after 20 updates and after 40, then one under no corruption
    settings = {"eval_length": 4, "eval_episodes": 2, "eval_clean_episodes": 1}
    results = tmp_path / "results"
    add_results([finetune(smoke_finetune(encoder, data, tmp_path / "run", **settings)).path], results)
    assert verify_results(results)[1] == []
    whole = {path: path.read_text() for path in results.glob("*.*")}
    for row, cells, expected in EDITED_ROWS:
        edited(results, row, **cells)
        found = verify_results(results)[1]
        assert [one for one in found if one.endswith(f": {expected}")], (cells, found)
        (results / "episodes.csv").write_text(whole[results / "episodes.csv"])
    for place, value, expected in EDITED_RECORDS:

        def edit(line: dict[str, Any], place: tuple[str, ...] = place, value: Any = value) -> None:
            for name in place[:-1]:
                line = line[name]
            assert line[place[-1]] != value
            line[place[-1]] = value

        found = changed(results, edit)
        assert [one for one in found if expected in one], (place, found)
        (results / "runs.jsonl").write_text(whole[results / "runs.jsonl"])
    head, first, second, *others = whole[results / "episodes.csv"].splitlines(keepends=True)
    (results / "episodes.csv").write_text("".join([head, second, first, *others]))
    (found,) = verify_results(results)[1]  # intervals pair episodes by their order
    assert found.endswith(f"at step 20 under {OWN} it has the episodes [1, 0], its record 2, from 0 on")
    (results / "episodes.csv").write_text(head)
    found = changed(results, lambda line: line.update(episodes=0))
    assert len(found) == 3, "two evaluations and an uncorrupted one"


def test_verify_compares_labels_and_returns_with_the_data(results):
    def edit(line: dict[str, Any]) -> None:
        line["config"]["collection"] = COLLECTED
        line["reference"] |= {"data_return": total}
        line["labels"] |= labels

    total, labels = 500.0, {}
    assert changed(results, edit) == []
    total = 250.0
    assert [one.partition(": ")[2] for one in changed(results, edit)] == [
        "its data return 250.0, but 500 times the mean reward 1.0 is 500.0000"
    ]
    total, labels = 500.0, {"quality": "medium"}
    assert "its labels have the quality medium, its data were collected as expert" in changed(results, edit)[0]


def test_verify_finds_repeated_and_foreign_rows(results):
    path = results / "episodes.csv"
    text = path.read_text()
    first = read_results(results)[0]
    lines = text.splitlines(keepends=True)
    path.write_text(text + lines[1] + lines[1].replace(first.id, "f00"))
    assert verify_results(results)[1] == [
        f"run {first.id}: 1 rows more than runs.jsonl says",
        "run f00: 1 rows more than runs.jsonl says",
    ]
    path.write_text(text)


def test_verify_finds_a_run_copied_as_another_seed(tmp_path):
    run = next(run for run in read_results(COMMITTED / "protocol") if run.labels["method"] == "mik+a" and run.rows)
    files = json.loads(json.dumps(run.files))
    for part in (files["labels"], files["config"]["config"], files["encoder"]["pretrain"]):
        part["seed"] = 9
    copy = replace(run, files=files, rows=[row | {"seed": 9} for row in run.rows])
    copy = replace(copy, id=identity(copy.record, copy.card))
    write_results(tmp_path, [run, copy])
    assert verify_results(tmp_path)[1] == [f"run {copy.id}: all its returns are those of run {run.id}, another seed"]
    sparse = [  # a goal is reached, or not
        replace(one, rows=[row | {"return": row["episode"] % 2, "score": row["episode"] % 2 / 10} for row in one.rows])
        for one in (run, copy)
    ]
    write_results(tmp_path / "sparse", sparse)
    assert verify_results(tmp_path / "sparse")[1] == []


@pytest.mark.parametrize(("name", "key"), [("reference", "data_return"), ("probe", "probe_pose")])
def test_numbers_that_are_not_finite_are_rejected(results, name, key):
    with pytest.raises(UserError, match=r"runs.jsonl: line 1: its files are damaged \(its probe or reference is not"):
        changed(results, lambda line: line[name].update({key: float("nan")}))


def test_records_of_endless_evaluations_are_contradicted_at_once(results):
    ends = {"updates": 10**12, "eval_every": 1, "eval_episodes": 10**12}
    found = changed(
        results, lambda line: (line["config"]["config"].update(ends), line["timing"].update(updates=10**12))
    )
    assert any("at step 1 under patch it has the episodes [], its record 1000000000000" in one for one in found)


CERTIFICATES = [
    (lambda text: "[]", "is not a JSON object"),
    (lambda text: '{"f00": {"data": 1}}', "f00: is damaged"),
    (lambda text: text.replace("1476f56a", "f00"), "its record computes 1476f56a3f00ac8172cb91e8"),
    (lambda text: text.replace('"zeroed_frames": 2', '"zeroed_frames": 1'), "its record computes"),
    (
        lambda text: text.replace('"verdict": "needs a', '"verdict": "needs no'),
        "says 'needs no memory of what was seen'",
    ),
    (lambda text: text.replace("supervised+a 0.78", "supervised+a 0.98"), "says 'R2: supervised+a 0.98"),
    (lambda text: text.replace("0.0533", "-0.0533"), "its numbers 'undecided'"),
]


@pytest.mark.parametrize(("change", "words"), CERTIFICATES)
def test_verify_recomputes_certificates(tmp_path, capsys, change, words):
    folder = shutil.copytree(COMMITTED / "protocol", tmp_path / "protocol")
    main(["results", "verify", str(folder)])
    file = folder / "certificates.json"
    file.write_text(change(file.read_text()))
    with pytest.raises(SystemExit) as ended:
        main(["results", "verify", str(folder)])
    assert ended.value.code == 2
    assert words in "".join(capsys.readouterr())


def test_changeable_settings_are_recorded_as_of_the_end(data, encoder, tmp_path, monkeypatch):
    run_until_cut(monkeypatch, 2, finetune, smoke_finetune(encoder, data, tmp_path / "run", eval_length=4))
    run = finetune(smoke_finetune(encoder, data, tmp_path / "run", eval_length=4, eval_clean=False, log_every=5)).path
    add_results([run], tmp_path / "results")
    (added,) = read_results(tmp_path / "results")
    assert (added.record["config"]["eval_clean"], added.record["config"]["log_every"]) == (False, 5)
    assert verify_results(tmp_path / "results")[1] == []


def test_verify_replays_an_episode_exactly(data, encoder, tmp_path, capsys):
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
    line = rejection([*words, str(run)])
    assert f"replays to return {row['return']} where it says {row['return'] + 1}; the row was made with mujoco" in line
    assert "another renderer" in line.partition(", this is ")[0]
    add_results([tmp_path / "other"], tmp_path / "without")
    assert "has no rows in the results folder; name a run that has" in rejection(
        ["results", "verify", str(tmp_path / "without"), "--replay", str(run)]
    )


@pytest.mark.parametrize("critic", [{"value": "much"}, {"moved": True}, {"moved": float("nan")}, {"valu": 1.0}, [1.0]])
def test_damaged_critic_is_rejected(tmp_path, critic):
    run = whole_run(tmp_path / "run")
    write_json(run / "critic.json", critic)
    with pytest.raises(UserError, match=r"critic|JSON object"):
        add_results([run], tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_empty_critic_contradicting_metrics_is_rejected(tmp_path):
    run = whole_run(tmp_path / "run")
    write_json(run / "critic.json", {})
    assert load_runs([run])[0].converged is True, "an algorithm without a critic"
    record = read_json(run / "config.json")
    write_json(run / "config.json", record | {"config": record["config"] | {"gamma": 0.99}})
    assert load_runs([run])[0].converged is None
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 10, "q": 150.0}) + "\n")
    with pytest.raises(UserError, match=r"critic\.json: has no critic, metrics\.jsonl has one; put it back"):
        add_results([run], tmp_path / "results")
