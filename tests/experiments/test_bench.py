import pytest

from vd4rl_pomdp.experiments.bench import data, training
from vd4rl_pomdp.experiments.bench.suite import GOALS
from vd4rl_pomdp.runs.files import flatten


def test_a_set_smaller_than_the_usual_one_can_be_measured(tmp_path, monkeypatch):
    dataset, opening = data.synthetic_set(tmp_path, 8)
    sections = {"opening": opening, "sampling": data.sampling(dataset, 5)}
    monkeypatch.setattr(training, "BATCH", 4)
    sections["finetuning"] = training.finetuning(dataset, 1)
    measured = flatten(sections)
    assert opening["rows"] == dataset.num_rows == 8 * data.EPISODE_ROWS
    assert all(value > 0 for value in measured.values())
    assert {name for name in GOALS if name.split(".")[0] in sections} <= set(measured)


def test_what_a_maze_step_spends_beside_the_network_is_timed_itself(monkeypatch):
    def in_turns(rounds, *functions):
        for function in functions:
            function()
        return [1.0, 0.1, 0.05]

    monkeypatch.setattr(training, "alternating", in_turns)
    assert training.maze_training() == {"training_steps_per_s": 1.0, "training_overhead_share": pytest.approx(0.15)}
