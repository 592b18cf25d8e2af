"""Planning of jobs: finished runs are matched by what they computed and on which data, in any folder."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from PIL import Image

from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.data.collect import CollectConfig, collection
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import Result, find_results
from vd4rl_pomdp.studies.navigation.pictures import source_fingerprint
from vd4rl_pomdp.sweeps import plan as module
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers
from vd4rl_pomdp.sweeps.plan import DATA, plan_jobs, runs_below, runs_kept
from vd4rl_pomdp.sweeps.stages import collection_of, recorded

GRID = """
seed = 0
preset = "smoke"
[collect]
task = "walker_walk"
quality = "expert"
[pretrain]
corruption = "patch"
[finetune]
eval_episodes = 1
workers = 1
eval_clean = false
[[block]]
pretrain = { method = ["acro", "bc"] }
[[block]]
pretrain = { method = "random", history = "gru" }
finetune = { random_histories = 0.5, algorithm = ["td3_bc", "bc"] }
"""


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A folder with the finished jobs of the grid, on a dataset without collection record."""
    out = tmp_path_factory.mktemp("swept")
    write_fake_set(out / "data" / "walker_walk" / "expert", [20, 25, 30])
    (out / "grid.toml").write_text(GRID)
    for job in plan(out):
        if not job.finished:
            main(list(job.words))
    return out


@pytest.fixture
def copy(swept, tmp_path):
    return shutil.copytree(swept, tmp_path / "copy")


def plan(folder: Path, changes=(), kept=(), data=None, others=(), out=None):
    """Jobs of a folder's grid, planned in `out` or the folder itself."""
    return planned(folder, changes, kept, data, others, out)[0]


def planned(folder: Path, changes=(), kept=(), data=None, others=(), out=None):
    """Jobs and warnings, as `plan`."""
    cells, out = load_grid(str(folder / "grid.toml"), changes).cells(), out or folder
    return plan_jobs(cells, out, data or out / DATA, kept, others)


def left(jobs):
    return [job.name for job in jobs if not job.finished]


def test_completed_runs_are_finished_jobs(swept):
    jobs = plan(swept)
    assert left(jobs) == []
    assert [job.name.removeprefix("walker_walk/expert/patch/") for job in jobs] == [
        "data/walker_walk/expert",
        "acro/seed0/pretrain",
        "acro/seed0/finetune-td3_bc",
        "bc/seed0/pretrain",
        "bc/seed0/finetune-bc",
        "random,history=gru/seed0/pretrain",
        "random,history=gru/seed0/finetune-td3_bc,random_histories=0.5",
        "random,history=gru/seed0/finetune-bc,random_histories=0.5",
    ]


def test_moved_runs_are_found_by_recipe_and_resumed_in_place(copy):
    (copy / "walker_walk" / "expert" / "patch" / "acro").rename(copy / "elsewhere")
    jobs = plan(copy)
    assert left(jobs) == []
    moved = {"elsewhere/seed0/pretrain", "elsewhere/seed0/finetune-td3_bc"}
    assert {job.name for job in jobs if "elsewhere" in job.name} == moved
    folder = copy / "elsewhere" / "seed0" / "finetune-td3_bc"
    (folder / "timing.json").unlink()
    (job,) = (job for job in plan(copy) if not job.finished)
    assert (job.folder, job.begun) == (folder, True)


def test_folder_names_of_other_runs_are_not_reused(copy):
    names = left(plan(copy, ["finetune.updates=20"]))
    assert len(names) == 4
    assert all("~" in name for name in names)
    assert left(plan(copy)) == []


def test_narrowed_and_changed_grid_have_separate_plans(tmp_path, monkeypatch):
    monkeypatch.setattr("vd4rl_pomdp.cli.sweeps.carry_out", lambda *_: None)
    (tmp_path / "grid.toml").write_text(GRID)
    for flag in ("--only", "--change"):
        main(["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path), flag, "preset=smoke"])
    assert len(SweepFolder(tmp_path).plans()) == 2


def test_folder_names_planned_by_another_grid_are_not_reused(tmp_path, capsys):
    """No run of either grid has begun."""
    folder = SweepFolder(tmp_path)
    (tmp_path / "grid.toml").write_text(GRID)
    first, second = plan(tmp_path, ["finetune.updates=30"]), ["--change", "finetune.updates=40", "--out", str(tmp_path)]
    folder.keep_plan("first", first)
    main(["sweep", "run", str(tmp_path / "grid.toml"), *second, "--dry-run"])
    named = {line.split(":")[0][2:] for line in capsys.readouterr().out.splitlines() if line.startswith("# ")}
    shared = {job.name for job in first if job.section != "finetune"}
    assert shared <= named
    assert sum("~" in name for name in named) == len(first) - len(shared)
    assert {job.name for job in first} & named == shared
    assert folder.jobs_of_others("first") == []
    assert plan(tmp_path, ["finetune.updates=30"], others=first) == first, "jobs of both grids are shared"


def test_folder_name_shows_corruption_options_set_by_where(tmp_path):
    grid = GRID.replace('task = "walker_walk"', 'task = ["walker_walk", "cheetah_run"]').split("[[block]]")[0]
    where = '[[where]]\nonly = ["task=cheetah_run"]\npretrain = { patch_size = 24, batch_size = 8 }\n'
    (tmp_path / "grid.toml").write_text(f'{grid}[[block]]\npretrain = {{ method = "acro" }}\n{where}')
    assert [job.name for job in plan(tmp_path) if job.section == "pretrain"] == [
        "walker_walk/expert/patch/acro/seed0/pretrain",
        "cheetah_run/expert/patch/acro,patch_size=24/seed0/pretrain",
    ]


def test_long_folder_names_are_replaced_by_a_hash(tmp_path):
    many = {name: 2 for name in ("batch_size", "hidden_dim", "views", "shift", "eval_every", "log_every", "n_step")}
    many |= {"checkpoint_every": 2, "eval_length": 2, "updates": 2, "learning_rate": 0.01, "alpha": 0.5, "gamma": 0.5}
    settings = ", ".join(f"{name} = {value}" for name, value in many.items())
    blocks = [f"[[block]]\nfinetune = {{ {settings}, eval_episodes = {episodes} }}\n" for episodes in (3, 4)]
    first = GRID.partition("[finetune]")[0] + 'method = "acro"\n'
    (tmp_path / "grid.toml").write_text(first + "".join(blocks))
    names = [Path(job.name).name for job in plan(tmp_path) if job.section == "finetune"]
    assert len(set(names)) == 2
    assert all(re.fullmatch(r"finetune-td3_bc,[0-9a-f]{24}", name) for name in names)


def test_runs_on_new_dataset_contents_get_new_folders(copy):
    folders = set()
    for length in (31, 32):
        shutil.rmtree(copy / "data" / "walker_walk")
        write_fake_set(copy / "data" / "walker_walk" / "expert", [20, 25, length])
        job = next(job for job in plan(copy) if not job.finished)
        assert job.folder not in folders
        assert not job.begun
        main(list(job.words))
        folders.add(job.folder)
        assert job.name not in left(plan(copy)), "it is found again"


def test_policy_with_encoder_of_another_dataset_is_not_finished(copy):
    folder = copy / "walker_walk" / "expert" / "patch" / "acro" / "seed0"
    shutil.rmtree(folder / "pretrain")
    card = folder / "finetune-td3_bc" / "encoder" / "config.json"
    content = read_json(card)
    write_json(card, content | {"pretrain": content["pretrain"] | {"data": "another"}})
    assert [name.split("/")[-1].split("~")[0] for name in left(plan(copy))] == ["pretrain", "finetune-td3_bc"]


def test_encoder_is_shared_and_not_needed_after_its_policies(copy):
    assert not any("pretrain" in name for name in left(plan(copy, ["finetune.algorithm=td3_bc,bc"])))
    shutil.rmtree(copy / "walker_walk" / "expert" / "patch" / "acro" / "seed0" / "pretrain")
    assert left(plan(copy)) == []
    assert len(left(plan(copy, ["seed=0,1"]))) == 7


def test_kept_rows_count_as_finished_and_changed_code_is_reported(copy, tmp_path, monkeypatch):
    main(["results", "add", *map(str, sorted(copy.rglob("finetune-*"))), "--out", str(tmp_path / "rows")])
    kept, new = runs_kept([tmp_path / "rows"]), tmp_path / "new"
    shutil.copytree(copy / "data", new / "data")
    assert len(left(plan(copy, out=new))) == 7
    assert left(plan(copy, kept=kept, out=new)) == []
    assert len(left(plan(copy, ["seed=0,1"], kept=kept, out=new))) == 7, "jobs of the other seed"
    monkeypatch.setattr(module, "of_other_code", lambda record, settings: ["method mine"])
    jobs, warnings = planned(copy, kept=kept, out=new)
    assert left(jobs) == []
    number = len(kept) + 1  # including their dataset
    assert warnings == [f"method mine: {number} sets or runs count, though its code has changed since they began"]


def test_policies_on_a_replaced_encoder_are_reported(copy):
    assert planned(copy)[1] == []
    config = next(copy.rglob("pretrain/encoder/config.json"))
    content = read_json(config)
    write_json(config, content | {"pretrain": content["pretrain"] | {"seed": 7}})
    jobs, warnings = planned(copy)
    assert left(jobs) == []
    number = len(list(config.parents[2].glob("finetune-*/config.json")))
    assert [line.partition(" that")[0] for line in warnings] == [f"{number} policies count"]
    shutil.rmtree(config.parents[1])
    assert planned(copy)[1] == []


def test_missing_dataset_of_finished_runs_is_reported(copy):
    record_collection(copy)
    (copy / "data" / "walker_walk" / "expert").rename(copy / "away")
    assert planned(copy)[1] == [], "nothing needs it"
    _, (warning,) = planned(copy, ["finetune.updates=7"])
    assert warning == (
        f"{copy}/data/walker_walk/expert: is missing and will be collected again, though 3 runs here were trained on "
        "it: put it back; if the content differs they do not count"
    )
    (copy / "away").rename(copy / "data" / "walker_walk" / "expert")
    assert planned(copy, ["finetune.updates=7"])[1] == []


def test_requested_or_needed_encoders_are_trained(copy, tmp_path):
    blocks = ["[[block]]\n", "[[block]]\nfinetune = { updates = 7 }\n"]
    head = GRID.partition("[finetune]")[0] + 'method = "acro"\n'
    (copy / "grid.toml").write_text(head + "".join(blocks[::-1]))
    new = tmp_path / "new"
    shutil.copytree(copy / "data", new / "data")
    shutil.copy(copy / "grid.toml", new)

    def stages(kept):
        found = plan(new, kept=runs_kept([kept]) if kept else ())
        return {job.section for job in found if not job.finished}

    pretrained = [
        path.parent for path in copy.rglob("pretrain/config.json") if read_json(path)["config"]["method"] == "acro"
    ]
    main(["results", "add", *map(str, pretrained), "--out", str(tmp_path / "encoders")])
    assert stages(None) == stages(tmp_path / "encoders") == {"pretrain", "finetune"}, "a row has no encoder weights"
    (job,) = (job for job in plan(copy) if job.section == "finetune")
    main(list(job.words))
    main(["results", "add", str(job.folder), "--out", str(tmp_path / "policies")])
    assert stages(tmp_path / "policies") == {"pretrain"}, "the encoder was requested"
    main(["results", "add", *map(str, pretrained), "--out", str(tmp_path / "policies")])
    assert stages(tmp_path / "policies") == set()


def record_collection(folder: Path) -> None:
    """Write into every run how its dataset was collected."""
    for config in folder.rglob("config.json"):
        if "stage" in (record := read_json(config)):
            collection = {"task": "walker_walk", "quality": "expert", "episodes": 200, "seed": 0, "render": "fast"}
            collection |= {"episodes_per_shard": 50, "actor": None, "action_noise": None, "actors": []}
            write_json(config, record | {"collection": collection})


def test_kept_rows_without_dataset_match_by_collection(copy, tmp_path):
    """Another row on the same content may record the collection."""
    record_collection(copy)
    early = next(copy.rglob("finetune-td3_bc/config.json"))
    write_json(early, {name: value for name, value in read_json(early).items() if name != "collection"})
    main(["results", "add", str(copy), "--out", str(tmp_path / "rows")])
    kept = runs_kept([tmp_path / "rows"])
    assert left(plan(copy, kept=kept, out=tmp_path / "new")) == []
    assert len(left(plan(copy, ["collect.episodes=100"], kept=kept, out=tmp_path / "new"))) == 8


@pytest.mark.parametrize(("lengths", "warned"), [([20, 25, 31], True), ([20, 25, 30], False)])
def test_kept_rows_of_other_dataset_content_are_reported(copy, tmp_path, capsys, lengths, warned):
    record_collection(copy)
    rows, new = tmp_path / "rows", tmp_path / "new"
    main(["results", "add", str(copy), "--out", str(rows)])
    write_fake_set(new / "data" / "walker_walk" / "expert", lengths)
    main(["sweep", "run", str(copy / "grid.toml"), "--out", str(new), "--done", str(rows), "--dry-run"])
    shown = capsys.readouterr()
    warning = "warning: walker_walk/expert: 4 kept runs are of a set collected alike, but with other content"
    assert (warning in shown.err) == warned
    assert f"{1 if warned else 5} done" in shown.out


def collected(**settings):
    """Content of a collection.json."""
    return collection(CollectConfig(task="walker_walk", quality="expert", out=Path("-"), **settings)) | {
        "actors": ["x"]
    }


@pytest.mark.parametrize(
    ("stored", "asked", "message"),
    [
        (
            {"episodes": 3},
            "collect.episodes=200",
            "a dataset of episodes 3, the grid says episodes 200; choose another",
        ),
        ({}, "collect.frame_size=48", "a dataset of the default frame_size, the grid says frame_size 48"),
        ({"frame_size": 48}, "collect.seed=0", "a dataset of frame_size 48, the grid says the default frame_size"),
    ],
)
def test_dataset_with_other_collection_settings_is_rejected(copy, stored, asked, message):
    write_json(copy / "data" / "walker_walk" / "expert" / "collection.json", collected(**stored))
    with pytest.raises(UserError, match=message):
        plan(copy, [asked])


@pytest.mark.parametrize("size", [48, 84])
def test_dataset_with_requested_collection_settings_is_accepted(copy, size):
    write_json(copy / "data" / "walker_walk" / "expert" / "collection.json", collected(frame_size=size, episodes=3))
    (copy / "data" / "walker_walk" / "expert" / "provenance.json").write_text("{}")
    assert left(plan(copy, [f"collect.frame_size={size}", "collect.episodes=3"])) == []


def test_uncollected_dataset_of_other_frame_size_is_rejected(copy):
    with pytest.raises(UserError, match=r"expert: holds frames of 84x84 pixels, the grid says 48; choose another"):
        plan(copy, ["collect.frame_size=48"])


def test_evaluation_length_follows_the_task(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID.replace("walker_walk", "long"))
    with TASKS.isolated():
        TASKS.register("long", replace(TASKS["walker_walk"], decisions=700))
        cell = load_grid(str(tmp_path / "grid.toml"), []).cells()[0]
        assert recorded(cell, "finetune")["eval_length"] == 5, "from the preset"
        usual = load_grid(str(tmp_path / "grid.toml"), ["finetune.eval_length=500"]).cells()[0]
        assert recorded(usual, "finetune")["eval_length"] == 700


def test_seeds_may_have_individual_datasets(copy, tmp_path):
    wheres = [f'[[where]]\nonly = ["seed={seed}"]\ncollect = {{ seed = {100 + seed} }}\n' for seed in (0, 1)]
    (copy / "grid.toml").write_text(GRID.replace("seed = 0", "seed = [0, 1]") + "".join(wheres))
    jobs = [job for job in plan(copy, out=tmp_path / "out") if "/acro/" in job.name or "data/" in job.name]
    assert {job.name: job.needs for job in jobs if job.section != "finetune"} == {
        f"data/walker_walk/expert,seed={100 + seed}": [] for seed in (0, 1)
    } | {
        f"walker_walk/expert,seed={100 + seed}/patch/acro/seed{seed}/pretrain": [
            f"data/walker_walk/expert,seed={100 + seed}"
        ]
        for seed in (0, 1)
    }
    collected = [job.words[job.words.index("--seed") + 1] for job in jobs if job.section == "collect"]
    assert collected == ["100", "101"]
    cells = load_grid(str(copy / "grid.toml")).cells()
    for collected, number in ((100, 4), (101, 0)):  # policies of seed 0 count only on the dataset of seed 0
        wanted = {"collection": collection_of(cells[0]) | {"seed": collected}}
        kept = [replace(run, files=run.files | {"config": run.record | wanted}) for run in runs_below(copy)]
        done = [job for job in plan(copy, kept=kept, out=tmp_path / "out") if job.done]
        assert ({job.section for job in done}, len(done)) == ({"finetune"} if number else set(), number)


def test_vd4rl_grid_uses_downloaded_datasets(tmp_path, capsys):
    for task in ("walker_walk", "cheetah_run"):
        for quality in ("medium_expert", "expert"):
            write_fake_set(tmp_path / "vd4rl" / task / quality / "84px", [20, 25])
    main(["sweep", "run", "vd4rl", "--data", str(tmp_path / "vd4rl"), "--out", str(tmp_path / "out"), "--dry-run"])
    shown = capsys.readouterr().out
    assert "data collect" not in shown
    assert f"--data {tmp_path}/vd4rl/walker_walk/expert/84px" in shown
    assert f"{4 * 6 * 5 * 2 + 4} jobs, 4 done" in shown, "6 encoders and policies per seed and dataset, 4 datasets"


def test_runs_with_other_exogenous_images_do_not_match(tmp_path):
    class AnySet:
        def made(self, record):
            return True

    Image.new("RGB", (9, 9), "red").save(tmp_path / "one.png")
    config = {"seed": 0, "exogenous": str(tmp_path)}
    record = {"stage": "navigation", "config": config, "inputs": {"exogenous": source_fingerprint(str(tmp_path))}}
    run = Result("", tmp_path / "run", {"config": record}, 0, [], [], True)
    assert module._found({run.recipe: [run]}, run.recipe, AnySet()) is run
    Image.new("RGB", (9, 9), "blue").save(tmp_path / "one.png")
    module._images_in.cache_clear()
    assert module._found({run.recipe: [run]}, run.recipe, AnySet()) is None


@pytest.mark.parametrize(("quality", "name"), [('"mine"', "mine"), ("2", "2")])
def test_user_defined_quality_is_used_if_present(tmp_path, capsys, quality, name):
    text = GRID.partition("[finetune]")[0].replace('"expert"', quality) + "method = 'random'"
    (tmp_path / "grid.toml").write_text(text)
    words = [str(tmp_path / "grid.toml"), "--out", str(tmp_path / "out")]
    assert f"{name}: holds no dataset, and the quality '{name}' cannot be collected" in rejection(
        ["sweep", "run", *words]
    )
    write_fake_set(tmp_path / "out" / "data" / "walker_walk" / name, [20, 25, 30])
    main(["sweep", "run", *words])
    assert capsys.readouterr().out == "all 2 jobs are finished\n"
    cells = load_grid(words[0]).cells()
    (run,) = find_results([tmp_path / "out"])
    assert run.labels["quality"] == name
    assert GridMembers("grid", cells).among([run]) == [run]


@pytest.mark.parametrize("quality", ["", ".", "..", "../../mine", "/mine"])
def test_qualities_that_are_no_folder_names_are_rejected(tmp_path, quality):
    (tmp_path / "grid.toml").write_text(GRID.replace('"expert"', f'"{quality}"'))
    with pytest.raises(UserError, match=f"collect has the quality '{quality}', which is no name of a folder"):
        plan(tmp_path)


def test_two_datasets_of_one_name_are_rejected(tmp_path):
    """A shared preset decides a maze dataset's size, its folder's name does not show it."""
    blocks = "".join(f'[[block]]\npreset = "{preset}"\n' for preset in ("smoke", "cpu"))
    maze = '[navigation_collect]\nmaze = "no_curtain"\n[navigation_train]\nmethod = "acro"\n'
    (tmp_path / "grid.toml").write_text(maze + blocks)
    with pytest.raises(UserError, match="no_curtain: the grid asks for trajectories 10 and 100 in one dataset: set"):
        plan(tmp_path)


def test_dataset_of_another_task_is_rejected(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    write_fake_set(tmp_path / "data" / "walker_walk" / "expert", [20, 25])
    shard = min((tmp_path / "data" / "walker_walk" / "expert").glob("*.hdf5"))
    with h5py.File(shard, "a") as file:
        file.attrs["vd4rl_pomdp"] = '{"task": "cheetah_run"}'
    with pytest.raises(UserError, match="expert: holds a dataset of cheetah_run, the grid says walker_walk"):
        plan(tmp_path)
