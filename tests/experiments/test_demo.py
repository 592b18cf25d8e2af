import pytest

from vd4rl_pomdp.experiments.demo import conclusion, demo_commands, demo_jobs
from vd4rl_pomdp.runs.episodes import append_episodes

METHODS = ("mik+a", "acro", "random")


@pytest.mark.parametrize("preset", ["cpu", "smoke"])
def test_the_demo_uses_every_stage(tmp_path, preset):
    words = list(demo_commands(demo_jobs(tmp_path, preset), 1))
    assert [stage[0] for stage in words] == ["data", *["pretrain", "finetune"] * 3]
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
