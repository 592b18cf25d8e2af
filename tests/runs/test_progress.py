from vd4rl_pomdp.runs.progress import ProgressLine


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_progress_lines_show_loss_speed_and_eta(capsys):
    clock = Clock()
    with ProgressLine("train", 1000, "steps", clock=clock) as progress:
        for step in range(1, 201):
            clock.now += 0.5 if step <= 100 else 10.0
            if step % 10 == 0:
                progress.advance(0, loss=1 / step)
            progress.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "train: 60/1000 steps  loss 0.01667  2 steps/s  ETA 0:07:50"  # half a minute
    assert lines[1] == "train: 101/1000 steps  loss 0.01  1.68 steps/s  ETA 0:08:54"
    assert len(lines) == 2 + 33
    assert lines[-1].startswith("train: 200/1000 steps  loss 0.005  0.19 steps/s  ETA 1:")


def test_eta_is_zero_beyond_planned_steps(capsys):
    clock = Clock()
    with ProgressLine("PPO", 100, "decisions", clock=clock) as progress:
        clock.now = 1.0
        progress.advance(200)
    assert capsys.readouterr().err == "PPO: 200/100 decisions  200 decisions/s  ETA 0:00:00\n"


def test_resumed_progress_prints_ten_lines_with_current_speed(capsys):
    clock = Clock()
    with ProgressLine("train", 1000, "steps", start=500, clock=clock) as progress:
        for _ in range(500):
            clock.now += 0.001
            progress.advance(loss=1.0)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[0] == "train: 550/1000 steps  loss 1  1e+03 steps/s  ETA 0:00:00"
    assert lines[-1].startswith("train: 1000/1000 steps")
