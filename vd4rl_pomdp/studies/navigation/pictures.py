"""What a model observes of a maze: the image, or a smaller or grey version of it, with optional exogenous noise.

Exogenous noise adds an image from a pool, unrelated to the agent, to each observation. A row's key selects the image,
so a row always shows the same one, as in a real environment. The pool consists of generated textures, of crops of the
two photographs in scikit-learn, or of a folder's images: CIFAR-10's python or binary files, PNG, JPEG.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from pickletools import genops
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.reading import PICTURES, damaged, read_bytes, rgb_of
from vd4rl_pomdp.core.streams import stream_seed
from vd4rl_pomdp.corruptions.keys import derive_keys, draw_integers
from vd4rl_pomdp.envs.mazes import PICTURE_SIZE

Picture = Literal["rgb100", "rgb50", "grey50"]
_HALF = PICTURE_SIZE // 2
SHAPES: dict[Picture, tuple[int, int]] = {"rgb100": (3, PICTURE_SIZE), "rgb50": (3, _HALF), "grey50": (1, _HALF)}
"""Channels and size of each observation format."""
TEXTURES, PHOTOGRAPHS = "textures", "photographs"
"""Built-in pools."""
POOL = 1024
"""Maximum images in a pool."""
_CIFAR_SIDE = 32
_CROPS = (120, 400)
"""Minimum and maximum side of a photograph's crop in pixels."""
_DISCS, _RADII, _CONTRAST = 300, (4.0, 60.0), 60.0
"""Of a texture: number of discs, their radius range in pixels, and the standard deviation of their colours."""


class ExogenousNoise:
    """Adds `weight` times an image of the pool to each observation and clips."""

    def __init__(self, source: str, weight: float, seed: int) -> None:
        self._weight = weight
        self._seed = stream_seed(seed, "exogenous", "choice")
        self.pool = load_pool(source, seed)
        """(P, 3, 100, 100) uint8."""

    def __call__(self, pictures: Tensor, key: Tensor) -> Tensor:
        """Noisy copies of (N, 3, 100, 100) uint8 images, drawn by (N,) int64 row keys."""
        self.pool = self.pool.to(pictures.device)
        chosen = draw_integers(derive_keys(self._seed, key), len(self.pool), 1)[:, 0]
        added = self.pool[chosen].float().mul_(self._weight)
        return added.add_(pictures).round_().clamp_(max=255).to(torch.uint8)


def source_fingerprint(source: str) -> str:
    """Hash of a pool's files; for a built-in pool, its name."""
    if source in _MADE:
        return source
    digest = hashlib.blake2b(digest_size=12)
    for path in _files(Path(source)):
        digest.update(hashlib.blake2b(read_bytes(path)).digest())
    return digest.hexdigest()


def load_pool(source: str, seed: int) -> Tensor:
    """Images to add: (P, 3, 100, 100) uint8, at most POOL; of PNG and JPEG files only the drawn ones are decoded.

    Raises:
        UserError: the source is neither a built-in pool nor a folder of image files.
    """
    rng = np.random.default_rng(stream_seed(seed, "exogenous", "images"))
    if source in _MADE:
        return _MADE[source](rng)
    if not Path(source).is_dir():
        raise UserError(f"{source}: no such folder; name one with images or use --exogenous {TEXTURES}")
    if not (files := _files(Path(source))):
        raise UserError(
            f"{source}: no readable image; name a folder with CIFAR-10's data_batch files (python or binary), with PNG "
            f"or JPEG files, or use --exogenous {TEXTURES}"
        )
    batches = {path: _read_cifar(path) for path in files if _is_cifar(path)}
    images = [(path, number) for path in files for number in range(len(batches[path]) if path in batches else 1)]
    drawn = [images[i] for i in rng.permutation(len(images))[:POOL]]
    pictures = (batches[path][number] if path in batches else _read_image(path) for path, number in drawn)
    return torch.cat([_to_size(picture[None]) for picture in pictures])


def _textures(rng: np.random.Generator) -> Tensor:
    """Dead leaves: overlapping discs with radius density r^-3 and colours around the image's mean.

    They have edge and scale statistics of natural images (Lee, Mumford, Huang 2001, "Occlusion models for natural
    images").
    """
    textures, (least, greatest) = [], _RADII
    for _ in range(POOL):
        mean = rng.uniform(0, 255) + rng.normal(0, _CONTRAST / 2, 3)
        image = Image.new("RGB", (PICTURE_SIZE, PICTURE_SIZE), tuple(mean.clip(0, 255).astype(int).tolist()))
        draw = ImageDraw.Draw(image)
        centres = rng.uniform(0, PICTURE_SIZE, (_DISCS, 2))
        radii = least / np.sqrt(1 - rng.random(_DISCS) * (1 - (least / greatest) ** 2))
        colours = rng.normal(mean, _CONTRAST, (_DISCS, 3)).clip(0, 255).astype(int)
        for (x, y), r, colour in zip(centres.tolist(), radii.tolist(), colours.tolist(), strict=True):
            draw.ellipse((x - r, y - r, x + r, y + r), fill=tuple(colour))
        textures.append(np.asarray(image))
    return _to_size(np.stack(textures))


def _photographs(rng: np.random.Generator) -> Tensor:
    """Random square crops, half of them mirrored."""
    from sklearn.datasets import load_sample_images

    photographs = load_sample_images().images
    crops = []
    for number in range(POOL):
        photograph = photographs[number % len(photographs)]
        side = int(rng.integers(*_CROPS))
        top, left = (int(rng.integers(length - side + 1)) for length in photograph.shape[:2])
        crop = photograph[top : top + side, left : left + side]
        crops.append(_to_size(np.ascontiguousarray(crop[:, ::-1] if rng.random() < 0.5 else crop)[None]))
    return torch.cat(crops)


_MADE = {TEXTURES: _textures, PHOTOGRAPHS: _photographs}
"""Built-in pools by name."""


def _files(folder: Path) -> list[Path]:
    """Sorted image files of a folder."""
    with disk_errors(folder):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
    visible = (path for path in files if not path.name.startswith("."))  # macOS writes ._x.png beside x.png
    return [path for path in visible if _is_cifar(path) or path.suffix.lower() in (".png", ".jpg", ".jpeg")]


def _is_cifar(path: Path) -> bool:
    return path.name.startswith(("data_batch", "test_batch"))


def _read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 of one PNG or JPEG file."""
    content = read_bytes(path)
    try:
        return np.asarray(rgb_of(Image.open(io.BytesIO(content), formats=PICTURES)))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:  # raised by Pillow
        raise UserError(f"{path}: cannot be read as an image ({error}); remove or replace it") from error


def _read_cifar(path: Path) -> np.ndarray:
    """(N, 32, 32, 3) uint8 of one CIFAR-10 file, at most POOL of them.

    A binary file has a label before every image. In a pickled batch, the pixels are the only long byte string, which is
    found without unpickling.
    """
    content, labels = read_bytes(path), int(path.suffix == ".bin")
    with damaged(path, "is not a CIFAR-10 file", "download CIFAR-10 again"):
        strings = [content] if labels else [a for _, a, _ in genops(content) if isinstance(a, str | bytes)]
        longest = max(strings, key=len, default=b"")
        raw = longest.encode("latin-1") if isinstance(longest, str) else longest
        images = np.frombuffer(raw, np.uint8).reshape(-1, labels + 3 * _CIFAR_SIDE**2)[:POOL]
        if not len(images) or (labels and images[:, 0].max() > 9):
            raise ValueError("it holds no images, or labels above 9")
    return images[:, labels:].reshape(-1, 3, _CIFAR_SIDE, _CIFAR_SIDE).transpose(0, 2, 3, 1)


def _to_size(images: np.ndarray) -> Tensor:
    """(N, H, W, 3) uint8 -> (N, 3, 100, 100) uint8."""
    planes = torch.from_numpy(np.array(images)).permute(0, 3, 1, 2).float()
    resized = F.interpolate(planes, (PICTURE_SIZE, PICTURE_SIZE), mode="bilinear", antialias=True)
    return resized.round_().clamp_(0, 255).to(torch.uint8)


def to_grey50(pictures: Tensor) -> Tensor:
    """Luminance averaged over 2x2 pixels: (N, 3, 100, 100) uint8 -> (N, 1, 50, 50) uint8."""
    weights = torch.tensor([0.299, 0.587, 0.114], device=pictures.device) / 4
    return torch.einsum("nchw,c->nhw", _sums(pictures).float(), weights).round_().to(torch.uint8)[:, None]


def to_rgb50(pictures: Tensor) -> Tensor:
    """Average over 2x2 pixels: (N, 3, 100, 100) uint8 -> (N, 3, 50, 50) uint8."""
    return ((_sums(pictures) + 2) // 4).to(torch.uint8)


def _sums(pictures: Tensor) -> Tensor:
    """Sums over 2x2 pixels, int16."""
    rows = pictures[..., ::2, :].short() + pictures[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]
