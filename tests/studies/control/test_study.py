import csv
from pathlib import Path

import pytest

from vd4rl_pomdp.cli import run_to_end
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.studies.control import study as module
from vd4rl_pomdp.studies.control.config import LABELS, ControlConfig, fitting_methods
from vd4rl_pomdp.studies.control.study import control_study
from vd4rl_pomdp.studies.control.training import _finite

TINY = {"episodes": 2, "decisions": 32, "pretrain_steps": 2, "updates": 2, "eval_episodes": 2, "action_noises": [0.5]}


def config(out: Path, **changes) -> ControlConfig:
    return ControlConfig(out, **TINY | {"methods": ["none", "mik+a"], "seeds": [0]} | changes)


def ran(config: ControlConfig) -> list[tuple[str, ...]]:
    """Run a study; labels of the rows that it told of."""
    told = []
    control_study(config, told.append)
    return [tuple(row[name] for name in LABELS) for row in told]


def tables(out: Path) -> list[list[dict[str, str]]]:
    """Rows of both files, without what differs from one time to another."""
    found = []
    for name in ("runs.csv", "episodes.csv"):
        with (out / name).open(newline="") as file:
            found.append([{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)])
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """An uninterrupted study of everything that can be compared."""
    out = tmp_path_factory.mktemp("whole")
    control_study(config(out, methods=fitting_methods()), lambda row: None)
    return out


def test_every_method_leaves_a_row_and_its_episodes(whole):
    runs, episodes = tables(whole)
    assert [row["method"] for row in runs] == ["none", "random", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a"]
    for run in runs:
        mine = [float(e["return"]) for e in episodes if e["method"] == run["method"]]
        assert len(mine) == 2
        assert float(run["return"]) == pytest.approx(sum(mine) / 2, abs=1e-4)
        assert (float(run["return_min"]), float(run["return_max"])) == pytest.approx((min(mine), max(mine)), abs=1e-4)
        assert (float(run["action_loss"]) > 0) == (run["method"] not in ("none", "random"))
    assert {e["episode_seed"] for e in episodes} == {"20000", "20001"}
    assert len({run["return"] for run in runs}) == len(runs), "no two methods are the same"


def test_a_runs_rows_do_not_depend_on_the_others(whole, tmp_path):
    control_study(config(tmp_path / "alone", methods=["mik+a"]), lambda row: None)
    for alone, all_of_them in zip(tables(tmp_path / "alone"), tables(whole), strict=True):
        assert alone == [row for row in all_of_them if row["method"] == "mik+a"]


def test_a_cut_study_goes_on_and_ends_in_the_same_rows(whole, tmp_path, monkeypatch):
    real, out = module.measured, tmp_path / "cut"

    def cut(run):
        if run.method == "mik+a":
            raise KeyboardInterrupt
        return real(run)

    monkeypatch.setattr(module, "measured", cut)
    with pytest.raises(KeyboardInterrupt):
        control_study(config(out), lambda row: None)
    assert [row["method"] for row in tables(out)[0]] == ["none"]
    again = []
    monkeypatch.setattr(module, "measured", lambda run: (again.append(run.method), real(run))[1])
    assert [labels[LABELS.index("method")] for labels in ran(config(out))] == ["none", "mik+a"]
    assert again == ["mik+a"]
    for ended, expected in zip(tables(out), tables(whole), strict=True):
        assert ended == [row for row in expected if row["method"] in ("none", "mik+a")]


def test_a_study_that_is_finished_is_told_again_and_not_run(whole, monkeypatch):
    before = tables(whole)
    monkeypatch.delattr(module, "measured")
    assert len(ran(config(whole, methods=fitting_methods()))) == len(before[0])
    assert tables(whole) == before


def test_a_run_whose_episodes_are_not_whole_counts_as_not_run(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "measured", lambda run: pytest.fail(run.method))
    for name, lines in (("runs.csv", 3), ("episodes.csv", 4)):
        kept = (whole / name).read_text().splitlines(keepends=True)[:lines]
        (tmp_path / name).write_text("".join(kept))
    with pytest.raises(pytest.fail.Exception, match="random"):
        control_study(config(tmp_path, methods=["none", "random"]), lambda row: None)
    runs, episodes = tables(tmp_path)
    assert ([row["method"] for row in runs], [row["method"] for row in episodes]) == (["none"], ["none"] * 2)


def test_rows_that_another_process_adds_before_this_one_owns_the_folder_stay(whole, tmp_path, monkeypatch):
    def owned_late(out):
        for name in ("runs.csv", "episodes.csv"):
            (out / name).write_bytes((whole / name).read_bytes())
        return owned(out)

    monkeypatch.setattr(module, "owned", owned_late)
    monkeypatch.delattr(module, "measured")
    assert len(ran(config(tmp_path))) == 2
    assert tables(tmp_path) == tables(whole)


def test_a_study_whose_folder_was_taken_over_writes_no_more(tmp_path, monkeypatch):
    real = module.measured

    def taken_over(run):
        (tmp_path / ".owner.json").write_text('{"host": "elsewhere", "pid": 1}')
        return real(run)

    monkeypatch.setattr(module, "measured", taken_over)
    with pytest.raises(UserError, match="was taken over by process 1 on elsewhere"):
        control_study(config(tmp_path), lambda row: None)
    assert tables(tmp_path) == [[], []]


def test_a_run_that_diverges_ends_the_study_with_what_its_user_can_do(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "measured", lambda run: _finite(run, {"critic_loss": float("nan")}))
    end = run_to_end(["control-study", "--out", str(tmp_path), "--methods", "none", "--seeds", "3"])
    told = "training diverged, none on walker_walk, seed 3: critic_loss is nan; leave it out of --methods or --seeds"
    assert (end.code, end.cause, end.line) == (1, "diverged", f"error: {told}")


def test_another_commands_folder_is_refused_and_stays_as_it_is(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds no control study"):
        control_study(config(tmp_path), lambda row: None)
    (tmp_path / "runs.csv").write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match=r"runs\.csv: has other columns"):
        control_study(config(tmp_path), lambda row: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "runs.csv"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ["ant"]}, "unknown task 'ant'"),
        ({"methods": ["mik", "acro"]}, "unknown method of this study 'acro': choose one of none, random, ah"),
        ({"seeds": [0, -1]}, "--seeds is -1"),
        ({"action_noises": [3.0]}, "--action-noises is 3.0"),
        ({"hidden_shares": [1.5]}, "--hidden-shares is 1.5"),
        ({"random_histories": [2.0]}, "--random-histories is 2.0"),
        ({"history_windows": [-1]}, "--history-windows is -1"),
        ({"episodes": 1}, "--episodes is 1; it must be at least 2"),
        ({"episodes": 10**6, "decisions": None}, "--episodes 1000000 takes"),
        ({"pretrain_steps": 0}, "--pretrain-steps is 0"),
        ({"updates": 0}, "--updates is 0"),
        ({"eval_episodes": 0}, "--eval-episodes is 0"),
        ({"decisions": 31}, "--decisions is 31; it must be at least 32 and at most 500"),
    ],
)
def test_a_slip_is_a_sentence_before_anything_is_played(changes, message, tmp_path):
    with pytest.raises(UserError) as error:
        control_study(config(tmp_path / "out", **changes), lambda row: None)
    assert message in str(error.value)
    assert not (tmp_path / "out").exists()


def test_runs_go_seed_by_seed_and_none_is_run_twice(tmp_path):
    windows = list(config(tmp_path, history_windows=[0, 4]).runs())
    assert [(run.method, run.history_window) for run in windows] == [("none", 0), ("mik+a", 0), ("mik+a", 4)]
    several = {"methods": ["mik+a"], "readouts": ["state", "frame"], "random_histories": [0.0, 0.5]}
    read = [(run.readout, run.random_histories) for run in config(tmp_path, **several).runs()]
    assert read == [("state", 0.0), ("state", 0.5), ("frame", 0.0)], "the newest frame alone has no history"
    runs = list(config(tmp_path, seeds=[0, 1, 0], hidden_shares=[0.5, 0.0]).runs())
    assert [(run.hidden_share, run.seed, run.method) for run in runs] == [
        (share, seed, method) for share in (0.5, 0.0) for seed in (0, 1) for method in ("none", "mik+a")
    ]
    assert runs[0].labels == {
        **{"task": "walker_walk", "action_noise": "0.5", "hidden_share": "0.5", "episodes": "2", "decisions": "32"},
        **{"pretrain_steps": "2", "updates": "2", "eval_episodes": "2", "method": "none", "seed": "0"},
        **{"readout": "state", "random_histories": "0", "history_window": "0"},
    }
