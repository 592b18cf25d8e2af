import numpy as np
import pytest
from PIL import Image, ImageSequence

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.mazes import HALF_SIZE, MAZES
from vd4rl_pomdp.studies.navigation.figures import write_film

MAZE = MAZES["three_curtains"]
TRUE, GUESS = (-1.0, 1.0), (1.0, -1.0)


def write_table(path, points):
    """Write a trajectory of (true, estimated) points."""
    rows = [f"{t},{x},{y},0,0,{ex},{ey},0,0,1\n" for t, ((x, y), (ex, ey)) in enumerate(points)]
    path.write_text("t,x,y,vx,vy,estimated_x,estimated_y,estimated_vx,estimated_vy,hidden\n" + "".join(rows))


def centre(panel: np.ndarray, colour: str) -> list[float]:
    """Position in the maze of the disc of a colour."""
    red, green, blue = panel.astype(int).transpose(2, 0, 1)
    rows, columns = np.nonzero((red > green + 80) & (blue < 60) if colour == "orange" else green > red + 80)
    side = panel.shape[1]
    x, y = columns.mean() / side, (panel.shape[0] - rows.mean()) / side  # the title is above
    return [(2 * number - 1) * HALF_SIZE for number in (x, y)]


def test_film_shows_true_and_estimated_positions(tmp_path):
    tables = {"right": [(TRUE, TRUE), (GUESS, GUESS), (TRUE, TRUE)], "wrong": [(TRUE, GUESS), (GUESS, TRUE)]}
    for name, points in tables.items():
        write_table(tmp_path / f"{name}.csv", points)
    write_film({name: tmp_path / f"{name}.csv" for name in tables}, MAZE, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert len(frames) == 2, "length of the shortest trajectory"
    for t, frame in enumerate(frames):
        for panel, points in zip(np.split(frame, 2, axis=1), tables.values(), strict=True):
            true, guess = points[t]
            assert centre(panel, "orange") == pytest.approx(guess, abs=0.1)
            if true != guess:  # elsewhere the ring covers the mass's edge
                assert centre(panel, "green") == pytest.approx(true, abs=0.1), "visible under a curtain"


@pytest.mark.parametrize("content", ["t,x\n0,one\n", None])
def test_invalid_trajectory_is_rejected(tmp_path, content):
    if content:
        (tmp_path / "bad.csv").write_text(content)
    with pytest.raises(UserError, match=r"bad\.csv: is not a trajectory of a run"):
        write_film({"a": tmp_path / "bad.csv"}, MAZE, tmp_path / "film.gif")
