"""The sky above the first person's maze: the cube texture that MuJoCo draws, and a panorama for the fast picture."""

from __future__ import annotations

import numpy as np

from vd4rl_pomdp.envs.mazes import Sky

FACE = 400
"""Texels along an edge of the cube."""
BINS = 2048
"""Columns of a panorama: azimuths from -pi on, counterclockwise."""
_TOP, _STARS, _FINE = np.array([0.4, 0.6, 0.8]), 0.01, 2
"""PointMaze's sky: the colour straight up (black is straight down), the share of white texels, their fineness."""
_ACROSS = (np.arange(FACE) + 0.5) / FACE * 2 - 1
_ROW, _COLUMN = (axis.ravel() for axis in np.meshgrid(_ACROSS, _ACROSS, indexing="ij"))
_ONE = np.ones(FACE * FACE)
_FACES = (
    (_ONE, _COLUMN, -_ROW),
    (-_ONE, -_COLUMN, -_ROW),
    (_COLUMN, -_ROW, _ONE),
    (_COLUMN, _ROW, -_ONE),
    (_COLUMN, -_ONE, -_ROW),
    (-_COLUMN, _ONE, -_ROW),
)
"""Where MuJoCo shows a face's texels: x, y and z of their directions."""


def sky_texture(sky: Sky) -> np.ndarray:
    """(6 * FACE * FACE * 3,) uint8, as in `tex_data` of a skybox of that size."""
    if sky == "none":
        return np.zeros(6 * FACE * FACE * 3, np.uint8)
    x, y, z = np.concatenate([np.stack(face) for face in _FACES], 1)
    if sky == "compass":
        return _bytes(_compass(np.arctan2(y, x)))
    colors = _gradient(np.arctan2(z, np.hypot(x, y)))
    return _bytes(colors + _star_light()[:, None] * (1 - colors))


def panorama(texture: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Colours (BINS, E, 3) uint8 of a `sky_texture` by azimuth and by (E,) elevations in radians."""
    azimuth = (np.arange(BINS)[:, None] + 0.5) / BINS * 2 * np.pi - np.pi
    level = np.cos(elevations)
    x, y, z = np.broadcast_arrays(np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevations))
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    found = np.zeros((*x.shape, 3), np.uint8)
    x, y, z = (side / largest for side in (x, y, z))
    places = ((x == 1, y, -z), (x == -1, -y, -z), (z == 1, x, -y), (z == -1, x, y), (y == -1, x, -z), (y == 1, -x, -z))
    for face, (there, column, row) in zip(texture.reshape(6, FACE, FACE, 3), places, strict=True):
        at = [np.minimum(((side[there] + 1) / 2 * FACE).astype(int), FACE - 1) for side in (row, column)]
        found[there] = face[at[0], at[1]]
    return found


def _bytes(colors: np.ndarray) -> np.ndarray:
    return (colors * 255 + 0.5).astype(np.uint8).ravel()


def _gradient(elevation: np.ndarray) -> np.ndarray:
    """(N, 3) colours in 0..1 by elevation: MuJoCo's builtin gradient."""
    share = elevation / (np.pi / 2)
    return (1 + share / np.sqrt(1 + share**2) * np.sqrt(2))[:, None] / 2 * _TOP


def _star_light() -> np.ndarray:
    """(6 * FACE * FACE,) shares of each texel that stars cover: the same stars always."""
    side = FACE * _FINE
    stars = np.random.default_rng(0).random((6, side, side), np.float32) < _STARS
    return stars.reshape(6, FACE, _FINE, FACE, _FINE).mean((2, 4)).ravel()


def _compass(azimuth: np.ndarray) -> np.ndarray:
    """(N, 3) colours in 0..1: the colour circle once around the horizon, whose luminance rises and falls once, too."""
    return 0.5 + 0.5 * np.cos(azimuth[:, None] - np.array([0, 2, 4]) * np.pi / 3)
