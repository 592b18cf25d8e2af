import io
import struct
from unittest import mock

import numpy as np
import pytest
import torch
from PIL import Image

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation import pictures
from vd4rl_pomdp.studies.navigation.collect import SAMPLES, sample_observations
from vd4rl_pomdp.studies.navigation.pictures import POOL, ExogenousNoise, load_pool, to_grey50, to_rgb50


@pytest.fixture(scope="module")
def noise() -> ExogenousNoise:
    return ExogenousNoise("photographs", 0.5, 0)


@pytest.mark.parametrize("name", ["photographs", "textures"])
def test_builtin_image_pools(name):
    pool = load_pool(name, 0)
    assert pool.shape == (POOL, 3, 100, 100)
    assert len({picture.numpy().tobytes() for picture in pool}) == POOL
    assert torch.equal(pool, load_pool(name, 0))
    assert not torch.equal(pool, load_pool(name, 1))
    neighbours = (pool[..., 1:].float() - pool[..., :-1].float()).abs().mean()
    between_images = (pool[1:].float() - pool[:-1].float()).abs().mean()
    assert neighbours < between_images / 3, "neighbouring pixels are similar"


def test_exogenous_image_is_determined_by_the_row(noise):
    pictures = torch.full((200, 3, 100, 100), 50, dtype=torch.uint8)
    key = torch.arange(200)
    first = noise(pictures, key)
    assert torch.equal(first, noise(pictures, key))
    assert torch.equal(first[7:9], noise(pictures[7:9], key[7:9]))
    assert len({picture.numpy().tobytes() for picture in first}) > 150
    assert not torch.equal(first, ExogenousNoise("photographs", 0.5, 1)(pictures, key))


def test_exogenous_noise_is_added_and_clipped(noise):
    dark, bright = (torch.full((50, 3, 100, 100), v, dtype=torch.uint8) for v in (0, 240))
    key = torch.arange(50)
    added = noise(dark, key)
    expected = (noise(dark, key).int() + 240).clamp(max=255)
    assert added.max() <= 128
    assert (noise(bright, key).int() - expected).abs().max() <= 1
    assert noise.pool.shape[1:] == added.shape[1:]


def cifar_binary(folder, count: int = 4) -> np.ndarray:
    images = np.random.default_rng(0).integers(0, 256, (count, 3072), dtype=np.uint8)
    records = np.concatenate([np.arange(count, dtype=np.uint8)[:, None], images], 1)
    (folder / "data_batch_1.bin").write_bytes(records.tobytes())
    return images


def deep_png() -> bytes:
    """Of 16 bits, as depth cameras and microscopes write."""
    file = io.BytesIO()
    Image.fromarray(np.arange(100, dtype=np.uint16).reshape(10, 10) * 600).save(file, "PNG")
    return file.getvalue()


def torn_png() -> bytes:
    """A PNG with a wrong chunk length."""
    whole = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    Image.fromarray(noise).save(whole, "PNG")
    raw = whole.getvalue()
    place = raw.index(b"IDAT")
    return raw[: place - 4] + struct.pack(">I", 100) + raw[place:]


def python_batch(pixels: bytes) -> bytes:
    """A protocol-2 pickle of {"data": pixels}, as Python 2 wrote strings."""
    return b"\x80\x02}q\x01U\x04dataq\x02T" + struct.pack("<i", len(pixels)) + pixels + b"q\x03s."


def test_cifar_binary_and_python_files_agree(tmp_path):
    for name in ("binary", "python"):
        (tmp_path / name).mkdir()
    images = cifar_binary(tmp_path / "binary")
    (tmp_path / "python" / "data_batch_1").write_bytes(python_batch(images.tobytes()))
    pools = [load_pool(str(tmp_path / name), 0) for name in ("binary", "python")]
    assert torch.equal(*pools)
    assert pools[0].shape == (4, 3, 100, 100)
    planes = images.reshape(4, 3, 32, 32).mean((2, 3))
    ours = pools[0].float().mean((2, 3)).numpy()
    assert np.abs(np.sort(planes, 0) - np.sort(ours, 0)).max() < 2


def test_pickles_are_not_executed(tmp_path):
    """A batch that would create a file if it were unpickled yields only its pixels."""
    pixels = bytes(range(256)) * 12
    call = b"cos\nsystem\nU" + bytes([len(f"touch {tmp_path}/harm")]) + f"touch {tmp_path}/harm".encode() + b"\x85R0"
    (tmp_path / "data_batch_1").write_bytes(b"\x80\x02" + call + python_batch(pixels)[2:])
    assert load_pool(str(tmp_path), 0).shape == (1, 3, 100, 100)
    assert not (tmp_path / "harm").exists()


def test_png_and_jpeg_images_are_read(tmp_path):
    Image.fromarray(np.full((40, 60, 3), 99, np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.full((30, 30), 10, np.uint8)).save(tmp_path / "b.JPG", "JPEG")
    pool = load_pool(str(tmp_path), 0)
    assert sorted(pool.float().mean((1, 2, 3)).tolist()) == pytest.approx([10, 99], abs=2)


def test_only_images_of_the_pool_are_read(tmp_path, monkeypatch):
    for level in range(10, 130, 10):
        Image.fromarray(np.full((20, 30, 3), level, np.uint8)).save(tmp_path / f"{level:03}.png")
    cifar_binary(tmp_path, count=3)
    whole = load_pool(str(tmp_path), 0)
    assert len(whole) == 15
    monkeypatch.setattr(pictures, "POOL", 6)
    with mock.patch.object(pictures, "_read_image", wraps=pictures._read_image) as read:
        assert torch.equal(load_pool(str(tmp_path), 0), whole[:6])
    assert 1 <= read.call_count <= 6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("notes.txt", b"no image", "no readable image"),
        ("data_batch_1.bin", b"\x00" * 3000, "is not a CIFAR-10 file"),
        ("data_batch_1.bin", b"\xff" * 3073, "labels above 9"),
        ("data_batch_1", python_batch(b"\x00" * 100), "is not a CIFAR-10 file"),
        ("data_batch_1", b"\xfe\xfe\xfe", "is not a CIFAR-10 file"),
        ("a.png", b"not a picture", "cannot be read as an image"),
        ("a.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n", "cannot identify image"),
        ("a.png", torn_png(), "cannot be read as an image"),
        ("a.png", deep_png(), "more than 8 bits per channel .*: convert it to 8 bits"),
    ],
)
def test_unusable_image_folders_are_rejected(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=message):
        load_pool(str(tmp_path), 0)


def test_textures_have_the_spectrum_of_natural_images():
    pool = load_pool("textures", 0)[:200].float().mean(1)
    power = (torch.fft.fft2(pool - pool.mean((1, 2), keepdim=True)).abs() ** 2).mean(0)
    frequency = torch.fft.fftfreq(100)[:, None].hypot(torch.fft.fftfreq(100)[None])
    chosen = (frequency > 0.02) & (frequency < 0.2)
    x, y = frequency[chosen].log(), power[chosen].log()
    slope = ((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum()
    assert -3.2 < slope < -1.6, "power decreases about as 1/f^2 (Field 1987)"


def test_grey50_averages_the_luminance():
    pictures = torch.randint(0, 256, (3, 3, 100, 100), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    luma = (pictures.double() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1)
    expected = luma.view(3, 50, 2, 50, 2).mean((2, 4))
    assert (to_grey50(pictures)[:, 0].double() - expected).abs().max() <= 0.51


def test_rgb50_averages_colours():
    pictures = torch.zeros(2, 3, 100, 100, dtype=torch.uint8)
    pictures[0, 2, ::2] = 201
    pictures[1, 0, :, :50] = 7
    small = to_rgb50(pictures)
    assert small.shape == (2, 3, 50, 50)
    assert (small[0, 2] == 101).all()
    assert (small[1, 0, :, :25] == 7).all()
    assert int((small > 0).sum()) == 2500 + 1250


def test_sample_observations_are_distinct():
    samples = sample_observations()
    assert list(samples) == [*MAZES, "three_curtains, grey50", "three_curtains, exogenous textures"]
    assert [len(pictures) for pictures in samples.values()] == [SAMPLES] * 11
    assert all(len({picture.tobytes() for picture in pictures}) > 1 for pictures in samples.values())
    assert len({pictures.tobytes() for pictures in samples.values()}) == 11
