import json
import re

import numpy as np
import pytest
from PIL import Image

from tests.helpers_data import fake_reward, write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import QUALITIES, SET_QUALITIES
from vd4rl_pomdp.core.text import markdown
from vd4rl_pomdp.data import card as module
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.data.folder import published_scores, read_set

MADE = {"task": "cheetah_run", "set": "medium_replay", "policy": "medium_replay", "seed": 7, "render": "fast"}


def fields(path):
    lines = [line.strip("| ").split(" | ") for line in path.read_text().splitlines() if line.startswith("| ")]
    return {line[0]: line[1] for line in lines if len(line) == 2}


def test_card_lists_contents_and_origin(tmp_path):
    folder = write_fake_set(tmp_path / "set", (12, 30, 12), attributes=MADE | {"actor_sha256": "ab" * 32})
    path = write_card(folder)
    returns = [sum(fake_reward(episode, t) for t in range(n - 1)) for episode, n in enumerate((12, 30, 12))]
    found = fields(path)
    assert (found["episodes"], found["rows"], found["rows per episode"]) == ("3", "54", "12 to 30")
    assert found["return, mean"] == f"{np.mean(returns):.3f}"
    assert found["return, lowest to highest"] == f"{min(returns):.3f} to {max(returns):.3f}"
    assert found["published return of plain BC on V-D4RL's dataset"] == "250"
    assert (found["seed"], found["render"]) == ("7", "fast")
    assert found["actor medium_replay, SHA-256"] == "ab" * 32
    assert "nearest to its place in the run" in path.read_text()
    with Image.open(folder / "card.png") as picture:
        assert picture.width > 600


def test_film_shows_one_episode_across_shards(tmp_path):
    folder = write_fake_set(tmp_path / "set", (12, 30, 20), cuts=(40, 50), attributes=MADE)
    film = module._film(read_set(folder), 2)
    assert film.shape == (module.FILM_FRAMES, 3, 84, 84)
    assert film[:, 0, 0, 0].tolist() == [2] * module.FILM_FRAMES  # the episode
    assert film[:, 2, 0, 0].tolist() == np.linspace(0, 19, module.FILM_FRAMES).astype(int).tolist()


def test_card_of_published_set_has_no_origin(tmp_path):
    folder = write_fake_set(tmp_path / "walker_walk" / "expert" / "84px")
    text = write_card(folder).read_text()
    assert text.startswith("# walker_walk, expert")
    assert "915" in text
    assert "seed" not in text


def test_card_of_single_shard_is_rejected(tmp_path):
    folder = write_fake_set(tmp_path / "set", (12, 30, 20), cuts=(40, 50))
    with pytest.raises(UserError, match="describes a whole dataset"):
        write_card(folder / "0_fake.hdf5")
    assert not list(folder.glob("card.*"))


def test_published_scores_cover_all_benchmark_sets():
    assert {(row["env"], row["dataset"]) for row in published_scores()} == {
        (t, q) for t in ("walker_walk", "cheetah_run", "humanoid_walk") for q in QUALITIES
    }
    assert set(module.HOW) == set(SET_QUALITIES)


def test_card_escapes_markup_in_names(tmp_path):
    hostile = "$\\frac$ | `a` <img src=x>\n# b"
    folder = write_fake_set(tmp_path / "set", attributes=MADE | {"set": hostile, "policy": "a|b", "actor_sha256": "f0"})
    record = {"command": f"vd4rl-pomdp --out 'x|`y`\n{hostile}'", "git_commit": "<b>", "versions": {"torch": "2|3"}}
    (folder / "provenance.json").write_text(json.dumps(record))
    text = write_card(folder).read_text(encoding="utf-8")
    assert [line for line in text.splitlines() if line.startswith("#")] == [f"# cheetah_run, {markdown(hostile)}"]
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 3 for row in rows), "two cells a row"
    assert "<b>" not in text
    assert "<img" not in re.sub("(`+) .*? \\1", "", text), "only in the command, which is code"
    assert (folder / "card.png").stat().st_size > 5_000


def test_card_of_a_user_set_does_not_name_the_actor_of_its_quality(tmp_path):
    own = write_fake_set(tmp_path / "own", attributes={"task": "walker_walk", "set": "expert"})
    text = module.write_card(own).read_text()
    assert "actor" not in text
    assert "A published dataset, or one that records no origin." in text


def test_card_replaces_links_instead_of_what_they_name(tmp_path):
    folder = write_fake_set(tmp_path / "set")
    (tmp_path / "mine").write_text("mine")
    for name in ("card.md", "card.png", ".card.md.tmp"):
        (folder / name).symlink_to(tmp_path / "mine")
    write_card(folder)
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (folder / "card.md").is_symlink()


@pytest.mark.parametrize(
    "odd", [{"actor_sha256": "f0"}, {"imported": "minari"}, {"imported": {"id": 5}}, {"task": ["a"], "seed": {}}]
)
def test_cards_of_odd_attributes_are_written(tmp_path, odd):
    assert write_card(write_fake_set(tmp_path / "set", attributes=odd)).read_text().startswith("# ")
