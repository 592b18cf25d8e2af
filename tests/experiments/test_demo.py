from vd4rl_pomdp.evaluation import append_episodes
from vd4rl_pomdp.experiments.demo import CORRUPTION, METHODS, conclusion


def test_the_demo_ends_with_means_of_the_last_evaluation_and_how_sure_they_are(tmp_path):
    labels = {
        "task": "walker_walk",
        "quality": "expert_noisy",
        "corruption": CORRUPTION,
        "algorithm": "td3_bc",
        "seed": 0,
    }
    for method in METHODS:
        rows = [
            labels
            | {"method": method, "step": step, "episode": i, "episode_seed": i, "return": value, "length": 500}
            | {"score": value / 10, "evaluated_under": under}
            for step, under, values in ((5, CORRUPTION, [999.0]), (10, CORRUPTION, [100.0, 140.0]), (10, "none", [7.0]))
            for i, value in enumerate(values)
        ]
        (tmp_path / method / "finetune").mkdir(parents=True)
        append_episodes(tmp_path / method / "finetune" / "episodes.csv", rows)
    head, *lines, caveat = conclusion(tmp_path)
    assert CORRUPTION in head
    assert [line.split(maxsplit=1) for line in lines] == [[method, "120 ± 20 (n = 2), 7 (n = 1)"] for method in METHODS]
    assert "One seed each" in caveat
