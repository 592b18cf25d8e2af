import pytest
from PIL import Image

from tests.experiments.navigation.test_report import write_run
from vd4rl_pomdp.experiments.demo import conclusion, demo_commands, demo_jobs, show_navigation
from vd4rl_pomdp.experiments.navigation.grid import Condition
from vd4rl_pomdp.runs.episodes import append_episodes
from vd4rl_pomdp.sweeps.plan import Job

METHODS = ("mik+a", "acro", "random")


@pytest.mark.parametrize("preset", ["cpu", "smoke"])
def test_the_demo_uses_every_stage(tmp_path, preset):
    words = list(demo_commands(demo_jobs(tmp_path, preset), 1))
    stages = ["data", *["pretrain", "finetune"] * 3, *["navigation"] * 3]
    assert [stage[0] for stage in words] == stages
    assert [stage[1] for stage in words[-3:]] == ["collect", "train", "train"]
    assert "three_curtains" in words[-3]
    assert [stage[stage.index("--workers") + 1] for stage in words if "--workers" in stage] == ["1"] * 5
    assert all(stage[stage.index("--preset") + 1] == preset for stage in words if "--preset" in stage)


def test_the_demo_ends_with_means_of_the_last_evaluation_and_how_sure_they_are(tmp_path):
    labels = {"task": "walker_walk", "quality": "expert_noisy", "corruption": "patch+zero_frames"}
    labels |= {"algorithm": "td3_bc", "seed": 0}
    jobs = demo_jobs(tmp_path)
    for job, method in zip((job for job in jobs if job.section == "finetune"), METHODS, strict=True):
        hidden = labels["corruption"]
        rows = [
            labels
            | {"method": method, "step": step, "episode": i, "episode_seed": i, "return": value, "length": 500}
            | {"score": value / 10, "evaluated_under": under}
            for step, under, values in ((5, hidden, [999.0]), (10, hidden, [100.0, 140.0]), (10, "none", [7.0]))
            for i, value in enumerate(values)
        ]
        job.folder.mkdir(parents=True)
        append_episodes(job.folder / "episodes.csv", rows)
    head, *lines, caveat = conclusion(jobs)
    assert labels["corruption"] in head
    assert [line.split(maxsplit=1) for line in lines] == [[method, "120 ± 20 (n = 2), 7 (n = 1)"] for method in METHODS]
    assert "One seed each" in caveat


def test_the_demo_ends_with_a_film_and_the_errors_behind_the_curtains(tmp_path):
    jobs = []
    for method, level in (("no_history", 80.0), ("mik+a", 7.4)):
        folder = write_run(tmp_path, Condition("three_curtains", method), 0, level)
        jobs.append(Job(method, "navigation_train", folder, ()))
    lines = list(show_navigation([*jobs, Job("set", "navigation_collect", tmp_path, ())], tmp_path / "film.gif"))
    assert [line.split() for line in lines[1:3]] == [["mik+a", "7"], ["no_history", "80"]]
    assert "film.gif" in lines[-1]
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 60
