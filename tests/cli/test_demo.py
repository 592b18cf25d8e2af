from collections import Counter

import pytest
from PIL import Image

from tests.studies.navigation.test_report import write_run
from vd4rl_pomdp.agents import shipped
from vd4rl_pomdp.cli import demo as demos
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.cli.demo import PAIR, demo_jobs
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.episodes import append_episodes
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.studies.navigation.runs import Condition

METHODS = ("mik+a", "acro", "random")
LABELS = {"task": "walker_walk", "quality": "expert_noisy", "corruption": "patch+zero_frames"}
LABELS |= {"algorithm": "td3_bc", "seed": 0}


def write_returns(jobs):
    """Write rows of two evaluations for every fine-tuning job."""
    for job, method in zip((job for job in jobs if job.section == "finetune"), METHODS, strict=True):
        rows = [
            LABELS
            | {"method": method, "step": step, "episode": i, "episode_seed": i, "return": value, "length": 500}
            | {"score": value / 10, "evaluated_under": LABELS["corruption"]}
            for step, values in ((5, [999.0]), (10, [100.0, 140.0]))
            for i, value in enumerate(values)
        ]
        job.folder.mkdir(parents=True)
        append_episodes(job.folder / "episodes.csv", rows)
        write_json(job.folder / "probe.json", {"probe_pose": 39.4, "probe_velocity": 53.6})


LEVELS = {"no_history": 80.0, "mik+a": 7.4}


def write_navigation(jobs):
    for job in jobs:
        if job.section == "navigation_train":
            method = job.folder.parent.name
            folder = write_run(job.folder.parents[2], Condition("three_curtains", method), 0, LEVELS[method])
            job.folder.parent.mkdir(parents=True)
            folder.rename(job.folder)


@pytest.mark.parametrize("preset", ["cpu", "smoke"])
def test_demo_uses_every_stage(tmp_path, preset):
    words = [job.words for job in demo_jobs(tmp_path, preset)]
    stages = ["data", *["pretrain", "finetune"] * 3, *["navigation"] * 3]
    assert [stage[0] for stage in words] == stages
    assert [stage[1] for stage in words[-3:]] == ["collect", "train", "train"]
    assert "three_curtains" in words[-3]
    assert all(stage[stage.index("--preset") + 1] == preset for stage in words if "--preset" in stage)


def test_demo_ends_with_report_conclusion_and_film(tmp_path, monkeypatch, capsys):
    carried, commands, played = [], [], []
    monkeypatch.setattr(demos, "report", lambda words, program: commands.append(words))
    monkeypatch.setattr(demos, "play", lambda words, program: played.append(words))

    def carry_out(plans, folder, kind, options):
        assert folder.plans() == plans, "plans are stored for `sweep status`"
        (jobs,) = (plan.jobs for plan in plans)
        carried.append((kind, options.jobs))
        write_returns(jobs)
        write_navigation(jobs)

    monkeypatch.setattr(demos, "carry_out", carry_out)
    main(["demo", "--out", str(tmp_path / "demo"), "--jobs", "3"])
    assert carried == [("local", 3)]
    assert played == [[*PAIR, "--episodes", "10", "--film", str(tmp_path / "demo" / "agents.webp")]]
    assert set(PAIR) <= set(shipped())
    assert commands == [[str(tmp_path / "demo" / "runs"), "--out", str(tmp_path / "demo" / "report")]]
    shown = capsys.readouterr()
    printed = [line.split()[2] for line in shown.err.splitlines() if line.startswith("$ vd4rl-pomdp")]
    assert Counter(printed) == {"data": 1, "pretrain": 3, "finetune": 3, "navigation": 3, "report": 1}
    out = [" ".join(line.split()) for line in shown.out.splitlines()]
    start = next(number for number, line in enumerate(out) if line.startswith(f"Under {LABELS['corruption']}, errors"))
    lines = [f"{method} 39, 54 120 ± 20 (n = 2)" for method in METHODS]
    assert out[start + 3 : start + 6] == lines, "means of the last evaluation with standard errors"
    assert out[start + 6].startswith("One seed each")
    assert {"mik+a 7", "no_history 80"} <= set(out), "navigation errors"
    with Image.open(tmp_path / "demo" / "navigation.gif") as film:
        assert film.n_frames == 60


def test_demo_runs_one_job_per_core_up_to_four(tmp_path, monkeypatch):
    at_once = []

    def carry_out(plans, folder, kind, options):
        at_once.append(options.jobs)
        raise UserError("far enough")

    monkeypatch.setattr(demos, "carry_out", carry_out)
    monkeypatch.setattr(demos, "play", lambda words, program: None)
    for gpus, cores in (([], 2), ([], 64), (["0"], 64)):
        monkeypatch.setattr("vd4rl_pomdp.sweeps.driver.visible_gpus", lambda gpus=gpus: gpus)
        monkeypatch.setattr("vd4rl_pomdp.runs.workers.count_workers", lambda wanted, cores=cores: wanted or cores)
        with pytest.raises(SystemExit, match="2"):
            main(["demo", "--out", str(tmp_path)])
    assert at_once == [2, 4, 0]
