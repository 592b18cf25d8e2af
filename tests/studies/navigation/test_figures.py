import numpy as np
import pytest
from PIL import Image, ImageSequence

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.mazes import BALL_RADIUS, MAZES
from vd4rl_pomdp.studies.navigation.figures import HEAD, SIDE, to_pixels, write_film

MAZE = MAZES["three_curtains"]
TRUE, GUESS = (-1.0, 1.0), (1.0, -1.0)


def write_table(path, points):
    """Write a trajectory of (true, estimated) points."""
    rows = [f"{t},{x},{y},0,0,{ex},{ey},0,0,1\n" for t, ((x, y), (ex, ey)) in enumerate(points)]
    path.write_text("t,x,y,vx,vy,estimated_x,estimated_y,estimated_vx,estimated_vy,hidden\n" + "".join(rows))


def frames_of(path) -> list[np.ndarray]:
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)]


def at(frame: np.ndarray, point: tuple[float, float], panel: int = 0) -> np.ndarray:
    column, row = to_pixels(*point)
    return frame[round(row), round(column) + panel * SIDE]


def ringed(frame: np.ndarray, point: tuple[float, float], panel: int) -> bool:
    """Whether the estimate's orange ring surrounds a point."""
    column, row = (round(number) for number in to_pixels(point[0] + BALL_RADIUS, point[1]))
    column += panel * SIDE
    there = frame[row - 2 : row + 3, column - 5 : column + 2]
    return bool(((there[..., 0] > 200) & (there[..., 2] < 60)).any())


def test_film_shows_true_and_estimated_positions(tmp_path):
    write_table(tmp_path / "right.csv", [(TRUE, TRUE), (GUESS, GUESS), (TRUE, TRUE)])
    write_table(tmp_path / "wrong.csv", [(TRUE, GUESS), (GUESS, TRUE)])
    write_film({"right": tmp_path / "right.csv", "wrong": tmp_path / "wrong.csv"}, MAZE, tmp_path / "film.gif")
    frames = frames_of(tmp_path / "film.gif")
    assert len(frames) == 2, "length of the shortest trajectory"
    assert frames[0].shape == (SIDE + HEAD, 2 * SIDE, 3)
    empty = at(frames[1], TRUE)
    assert np.abs(at(frames[0], TRUE) - empty).max() > 5, "the mass is visible under a curtain"
    assert np.abs(at(frames[0], TRUE, 1) - empty).max() > 5
    rings = [[ringed(frames[0], point, panel) for point in (TRUE, GUESS)] for panel in (0, 1)]
    assert rings == [[True, False], [False, True]]
    assert [[ringed(frames[1], point, panel) for point in (TRUE, GUESS)] for panel in (0, 1)] == rings[::-1]


def test_invalid_trajectory_is_rejected(tmp_path):
    (tmp_path / "bad.csv").write_text("t,x\n0,one\n")
    with pytest.raises(UserError, match=r"bad\.csv: is not a trajectory of a run"):
        write_film({"a": tmp_path / "bad.csv"}, MAZE, tmp_path / "film.gif")
    with pytest.raises(UserError, match=r"none\.csv: is not a trajectory"):
        write_film({"a": tmp_path / "none.csv"}, MAZE, tmp_path / "film.gif")
