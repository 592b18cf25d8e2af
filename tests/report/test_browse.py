"""The dataset viewer's page holds the frames, corruptions, actions and rewards of the dataset."""

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys, make_corruption
from vd4rl_pomdp.data import View, open_dataset


def content_of(page: Path) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="content">(.*?)</script>', page.read_text())[1])


def pixels(sheet: str, content: dict, count: int) -> np.ndarray:
    """(count, S, S, C) pictures of a sheet."""
    image, size = np.asarray(Image.open(io.BytesIO(base64.b64decode(sheet)))), content["size"]
    cells = [divmod(i, content["columns"]) for i in range(count)]
    return np.stack([image[y * size : (y + 1) * size, x * size : (x + 1) * size] for y, x in cells])


@pytest.mark.parametrize(("size", "every"), [(32, 1), (150, 2)])
def test_viewer_shows_corrupted_frames_and_stored_curves(tmp_path, size, every):
    folder = write_fake_set(tmp_path / "walker_walk" / "expert", [7, 1, 12], noise=size)
    words = ["--corruption", "patch+zero_frames", "--patch-fill", "9", "--zeroed-frames", "1", "--seed", "3"]
    main(["data", "view", str(folder), "--out", str(tmp_path / "new" / "view.html"), *words])
    content, data = content_of(tmp_path / "new" / "view.html"), open_dataset(folder)
    assert [(e["number"], e["length"]) for e in content["episodes"]] == [(0, 7), (1, 1), (2, 12)]
    hidden = make_corruption(CorruptionConfig.of("patch+zero_frames", patch_fill=9, zeroed_frames=1))
    pretraining = View(data, CorruptionConfig.of("patch", "emission"), seed=3).corruption
    for episode in content["episodes"]:
        rows = data.rows_of(episode["number"]).start + torch.tensor(episode["rows"])
        key = torch.tensor(list(map(int, episode["keys"])))
        assert torch.equal(key, derive_keys(pretraining.stream.seed, data.keys(rows))), "as runs of this seed"
        stacks = View(data).stacks(rows)
        clean, seen = (
            x.reshape(-1, 3, size, size)[..., ::every, ::every].permute(0, 2, 3, 1).numpy()
            for x in (stacks, hidden(stacks, key))
        )
        over = pixels(episode["over"], content, len(clean))
        assert np.array_equal(np.where(over[..., 3:] > 0, over[..., :3], clean), seen)
        frames = pixels(episode["clean"], content, max(map(max, episode["frames"])) + 1)
        lossy = frames[np.array(episode["frames"]).flatten()].astype(float)
        assert np.corrcoef(lossy.flatten(), clean.flatten())[0, 1] > 0.5, "noise at low image quality"
        for name, values in (("action", data.action), ("reward", data.reward[:, None])):
            low, high = content[name]
            shown = np.frombuffer(base64.b64decode(episode[name]), np.uint8).reshape(values.shape[1], -1)
            stored = values[data.rows_of(episode["number"])].T
            np.testing.assert_allclose(low + shown / 255 * (high - low), stored, atol=(high - low) / 500)


def test_viewer_page_fits_5_MB_and_needs_no_network(tmp_path):
    folder = write_fake_set(tmp_path / "cheetah_run" / "random", [40] * 120, noise=48)
    main(["data", "view", str(folder), "--out", str(tmp_path / "view.html")])
    page, content = (tmp_path / "view.html").read_text(), content_of(tmp_path / "view.html")
    assert 3_500_000 < len(page.encode()) < 5_000_000
    assert len({e["number"] for e in content["episodes"]}) == len(content["episodes"]) == 100
    shown = {len(e["rows"]) for e in content["episodes"]}
    assert shown <= set(range(2, 40))
    assert f"of an episode of 40 rows {max(shown)} are shown" in page
    assert "100 of 120 episodes, evenly spaced" in page
    assert re.findall(r"https?://|//[a-z]|@import|\bfetch\(|<link|src=(?!\")", page.replace(*_data(page))) == []


def _data(page: str) -> tuple[str, str]:
    return re.search(r'id="content">(.*?)</script>', page)[1], ""


def test_viewer_overwrites_only_its_own_page(tmp_path):
    folder, out = write_fake_set(tmp_path / "walker_walk" / "expert", [5], noise=16), tmp_path / "view.html"
    for corruption in ("patch", "none"):
        main(["data", "view", str(folder), "--out", str(out), "--corruption", corruption])
    assert 'id="on"' not in out.read_text(), "no switch without corruption"
    out.write_text("mine")
    for place in (out, tmp_path, folder / "view.html"):
        rejection(["data", "view", str(folder), "--out", str(place)])
    assert out.read_text() == "mine"
    assert "patch size 17 exceeds the image (16x16)" in rejection(
        ["data", "view", str(folder), "--out", str(tmp_path / "new.html"), "--patch-size", "17"]
    )
